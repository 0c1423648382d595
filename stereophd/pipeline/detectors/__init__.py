"""Estimation of the detectors of cameras from a log."""
