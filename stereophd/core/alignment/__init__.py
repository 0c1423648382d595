"""Frames: where tracks and cameras lie in a world that a control track, the floor, gravity or a camera defines."""
