"""Tracks of a recording that is still running: frames in the order of their arrival, estimates in that of time."""
