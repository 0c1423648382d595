"""Checks of the cameras by where rays of different cameras meet."""
