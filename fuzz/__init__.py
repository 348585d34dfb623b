"""Coverage-guided fuzz targets: each target is a function that takes bytes and fails on a fault.

The targets are independent of the fuzzer: the tests run the same functions on the inputs stored in
`fuzz/corpus` and `fuzz/findings`. `python -m fuzz` runs atheris to find further inputs.
"""
