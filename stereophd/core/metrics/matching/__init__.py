"""Estimates matched with true objects."""
