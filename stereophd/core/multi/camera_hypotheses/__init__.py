"""Filters under many hypotheses about the cameras at once."""
