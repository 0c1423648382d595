"""Detection logs, read and written."""
