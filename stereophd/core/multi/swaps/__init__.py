"""Pairs of tracks that took each other's detections, found while the filter runs."""
