"""Whole tracks: smoothing, stitching, reaching back to earlier detections."""
