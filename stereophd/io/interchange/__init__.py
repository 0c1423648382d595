"""Shared parts of all foreign formats: their registry, recordings in memory, and the way into a native log."""
