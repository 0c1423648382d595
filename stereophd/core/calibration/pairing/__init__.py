"""Which tracks of different cameras are one object: rays, pairs, search, association."""
