"""One file a command: open, call, write."""
