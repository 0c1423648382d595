"""Calibration: from a configuration and a log to an outcome."""
