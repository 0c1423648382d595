"""Configuration and streams to results in memory."""
