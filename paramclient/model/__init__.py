"""Plain data: values, parameters, parameter sets, identities, comparison, JSON notation,
words.

- `values`, `params`, `paramset`, `identity`: types and encodings, tables, sets without a vehicle, vehicle
  identity.
- `comparison`, `patterns`, `notation`: comparison of sets, selection of names, JSON notation.
- `wording`: counts and lists of names in messages.
"""
