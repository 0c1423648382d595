"""What the scenarios of one object share."""
