"""Contents of files: summaries of logs, tables and cameras as JSON-able dictionaries."""
