"""Logs that are still being written: messages of frames, and where they come from."""
