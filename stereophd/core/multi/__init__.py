"""Many objects: intensities as Gaussian mixtures over the cameras' disparity spaces (paper VI)."""
