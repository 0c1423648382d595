"""stereophd: 3-D tracks from the detection logs of fixed cameras."""

__version__ = "0.1.0"
