"""Plain data: values, parameters, parameter sets, identities, comparison, JSON notation,
words.

- `values`, `params`, `paramset`, `identity`: types and encodings, tables, sets without a vehicle, vehicle
  identity.
- `ext_values`: values of extended parameters, with text and bytes.
- `defaults`: the firmware's default of a parameter, of the vehicle or its metadata.
- `comparison`, `notation`: comparison of sets, JSON notation.
- `names`: selection of names, similar names, switches of groups.
- `px4_hash`: PX4's hash of its parameters, and the ones that it excludes.
- `wording`: counts and lists of names in messages.
"""
