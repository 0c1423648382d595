"""The Gaussian-mixture PHD filter on disparity space."""
