"""The state of a filter of many objects, what goes into an update and what comes out of it."""
