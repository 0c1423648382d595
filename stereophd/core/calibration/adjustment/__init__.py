"""Cameras and trajectories fitted to detections: the problem, its solver, the marginal posterior, what is left out."""
