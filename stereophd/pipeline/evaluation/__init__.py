"""Evaluation: inputs, options and reports."""
