"""Checks of the figures of a run."""
