"""Checks of the residuals of tracks."""
