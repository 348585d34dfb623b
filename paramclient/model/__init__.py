"""Plain data: values, parameters, parameter sets, identities, comparison, JSON notation.

- `values`: types, encodings, parameters; values of extended parameters, with text and bytes.
- `paramset`, `identity`: sets without a vehicle, tables, defaults of the firmware; vehicle identity.
- `comparison`, `notation`: comparison of sets, JSON notation.
- `names`: selection of names, similar names, switches of groups; counts and lists in messages.
- `px4_hash`: PX4's hash of its parameters, and the ones that it excludes.
"""
