"""The published networks in our own code, one file an idea: tensors in, tensors out, official checkpoints load.

Written from the papers; `tests/core/networks` holds them against outputs of the official implementations.
"""
