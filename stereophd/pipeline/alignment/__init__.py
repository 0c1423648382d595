"""Cameras and tracks in a world frame: control files, and what moves the files of a run."""
