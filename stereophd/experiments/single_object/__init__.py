"""Shared parts of the scenarios of one object."""
