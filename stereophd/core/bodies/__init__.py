"""Bodies: objects of a size, which detectors report as boxes and which hide one another."""
