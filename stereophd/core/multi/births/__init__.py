"""Newborn objects: where objects may be that no camera has detected yet, and what is in view."""
