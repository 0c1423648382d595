"""Cameras in files: the validated form of ``cameras.yaml``, to and from the geometric cameras, and its writing."""
