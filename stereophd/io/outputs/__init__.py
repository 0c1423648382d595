"""Outputs in one step: atomic writes, one commit of a folder, locks, unfinished runs, provenance."""
