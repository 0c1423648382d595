"""What a file holds: summaries of logs, tables and cameras as JSON-able dictionaries."""
