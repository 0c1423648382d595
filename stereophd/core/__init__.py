"""Arrays and frozen dataclasses: the mathematics, in the order of the paper; no files, no configuration."""
