"""The Poisson multi-Bernoulli filter on disparity space."""
