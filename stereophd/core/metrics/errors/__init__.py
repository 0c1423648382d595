"""Errors of matched estimates, and whether their covariances state them."""
