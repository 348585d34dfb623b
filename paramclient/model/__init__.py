"""Plain data: values, parameters, parameter sets, identities, comparison, JSON notation,
words.

- `values`, `params`, `paramset`, `identity`: types and encodings, tables, sets without a vehicle, vehicle
  identity.
- `comparison`, `patterns`, `notation`: comparison of sets, selection of names, JSON notation.
- `renames`: names that firmware versions have changed, and the conversion of their values.
- `wording`: counts and lists of names in messages.
"""
