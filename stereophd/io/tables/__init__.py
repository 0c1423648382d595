"""Parquet tables, read and written."""
