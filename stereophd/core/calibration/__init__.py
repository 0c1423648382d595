"""Calibration of the cameras from the moving objects themselves (paper section VII)."""
