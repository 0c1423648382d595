"""What every long run shares: its size, its progress, what it keeps while it is unfinished."""
