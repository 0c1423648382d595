"""One object, no clutter: estimation on disparity space, and what it is compared with (paper V, VIII-A, VIII-B)."""
