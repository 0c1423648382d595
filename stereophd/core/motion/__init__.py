"""Motion models: how objects move between two events."""
