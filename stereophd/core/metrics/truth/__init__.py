"""The truth: interpolated, seen by cameras, registered, as events."""
