"""Layout of a packed camera, and the codes of the lens models, as compiled kernels read them.

Plain constants without numba, so that reading a configuration does not pay for importing a compiler.
Numba caches compiled kernels by the file of each kernel: after changing a value here, delete the
``__pycache__`` folders of the package.
"""

from typing import Final

LENS_NONE: Final = 0
LENS_RADIAL: Final = 1
LENS_BROWN_CONRADY: Final = 2
LENS_FISHEYE: Final = 3

# Indices into the array of `Camera.packed`.
FX: Final = 0
FY: Final = 1
CX: Final = 2
CY: Final = 3
WIDTH: Final = 4
HEIGHT: Final = 5
CENTER: Final = 6  # 3 values
ROTATION: Final = 9  # 9 values, row-major
LENS_CODE: Final = 18
LENS_COEFFICIENTS: Final = 19  # 8 values: k1 k2 p1 p2 k3 k4 k5 k6 (fisheye: k1 k2 k3 k4 0 0 0 0)
MAX_RADIUS: Final = 27
PACKED_SIZE: Final = 28
