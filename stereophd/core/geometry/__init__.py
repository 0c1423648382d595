"""Cameras, poses and lenses: from world positions to pixels and back."""
