"""Geometry of two views: distances to epipolar lines."""
