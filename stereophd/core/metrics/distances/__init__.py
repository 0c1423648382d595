"""Distances between sets of objects and between sets of trajectories."""
