"""Checks of a log by itself."""
