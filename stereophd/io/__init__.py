"""Files: detection logs, tables, provenance, atomic writes, foreign formats."""
