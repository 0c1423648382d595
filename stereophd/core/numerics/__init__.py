"""Compilation, small linear algebra, sample sets, resampling, random streams."""
