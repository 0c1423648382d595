"""Cameras from nothing: poses and clocks of cameras from the one-camera tracks of moving objects alone."""
