"""Two views of one object: one-camera tracks, their rays at common times, epipolar distances, where rays meet."""
