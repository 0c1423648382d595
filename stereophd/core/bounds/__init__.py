"""Cramer-Rao bounds, and least squares with known association."""
