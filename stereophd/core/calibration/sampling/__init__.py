"""Samplers of camera states: the paper's single-cluster PHD filter and bridges between densities."""
