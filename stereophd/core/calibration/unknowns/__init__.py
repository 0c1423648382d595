"""What is unknown about cameras: quantities, parameters, the scale, and what the data determine."""
