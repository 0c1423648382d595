"""Checks: does a log fit the cameras and the settings? Findings name the likely cause and a remedy."""
