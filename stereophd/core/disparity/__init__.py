"""Disparity space: where projection is linear and far objects stay Gaussian (paper III to V)."""
