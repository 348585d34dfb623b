"""Plain data: values, parameters, parameter sets, identities, comparison, JSON notation.

- `values`, `params`, `paramset`, `identity`: types and encodings, tables, sets without a vehicle, vehicle
  identity.
- `comparison`, `patterns`, `notation`: comparison of sets, selection of names, JSON notation.
"""
