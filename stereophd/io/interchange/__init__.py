"""What all foreign formats share: their registry, recordings in memory, and the way into a native log."""
