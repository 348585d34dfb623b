"""Bytes at random, led by what they reach: each target is a function that takes bytes and finds fault.

A target knows nothing of the fuzzer: the tests run the same functions on the bytes that are kept in
`fuzz/corpus` and `fuzz/findings`. `python -m fuzz` lets atheris look for more.
"""
