"""Estimates and truth brought to the same scans, and the figures of a run, on arrays.

`alignment` says which events are scored and where the true objects are then, `visibility` which of them
the cameras have seen, `summary` sums up the scores. Nothing here knows files: `stereophd.evaluate` does.
"""
