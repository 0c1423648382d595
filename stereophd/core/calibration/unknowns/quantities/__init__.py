"""Unknown quantities of a camera: one file each, found by name in `registry`."""
