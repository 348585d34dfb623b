"""Plain data: values, parameters, parameter sets, identities, comparison, JSON notation,
words.

- `values`, `params`, `paramset`, `identity`: types and encodings, tables, sets without a vehicle, vehicle
  identity.
- `ext_params`: extended parameters, with text and 64-bit values.
- `comparison`, `patterns`, `notation`: comparison of sets, selection of names, JSON notation.
- `group_switches`: parameters that others depend on.
- `renames`: names that firmware versions have changed, and the conversion of their values.
- `wording`: counts and lists of names in messages.
"""
