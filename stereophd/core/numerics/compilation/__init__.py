"""Compiled kernels: how they are compiled, kept, and made ready ahead of time."""
