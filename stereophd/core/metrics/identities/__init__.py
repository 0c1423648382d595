"""How well tracks keep the identities of objects."""
