"""Coefficients of direct linear transformations, as DLTdv, easyWand and Argus take them: a table of 11 rows.

One column for each camera, in their order: ``u = (L1 X + L2 Y + L3 Z + L4) / (L9 X + L10 Y + L11 Z + 1)``, v likewise
with L5 to L8. Rows count from the bottom of the image, and the centre of the first pixel is (1, 1). The format holds
neither names, image sizes nor lenses: the coefficients are those of undistorted pixels.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from stereophd.errors import InputError
from stereophd.io.cameras.models import CameraConfig
from stereophd.io.formats.dltdv import COEFFICIENTS, is_profile, read
from stereophd.io.interchange.base import Format
from stereophd.io.interchange.cameras import take_apart
from stereophd.io.interchange.documents.text_tables import read_matrix

# The largest coefficient over the last one beyond which the world's origin is in the plane of the camera.
LARGEST_COEFFICIENT = 1e12


def recognises_cameras(path: Path) -> bool:
    """Whether a file is a table of 11 rows and a few columns of numbers."""
    if path.is_dir() or path.suffix.lower() not in (".csv", ".txt", ".dat", ".dlt", ""):
        return False
    table = read_matrix(path)
    return table is not None and table.shape[0] == COEFFICIENTS and not is_profile(table)


def write_cameras(cameras: Mapping[str, CameraConfig], length_unit: str, target: Path) -> list[str]:
    """Write the coefficients of all cameras."""
    columns, losses = [], [f"the columns are the cameras {', '.join(cameras)}; lengths are in {length_unit}"]
    for name, config in cameras.items():
        parts = take_apart(name, config)
        to_bottom = np.array([[1.0, 0.0, 1.0], [0.0, -1.0, parts.size[1]], [0.0, 0.0, 1.0]])
        projection = to_bottom @ parts.matrix @ np.column_stack([parts.rotation, parts.translation])
        if np.abs(projection).max() > LARGEST_COEFFICIENT * abs(projection[2, 3]):
            raise InputError(
                f"cameras.{name}: expected the world's origin in front of the camera, found it beside the camera"
            )
        columns.append((projection / projection[2, 3]).ravel()[:COEFFICIENTS])
        if parts.coefficients.any():
            losses.append(f"the lens of {name} is left out: the coefficients are those of undistorted pixels")
    rows = [",".join(map(repr, row)) for row in np.array(columns).T.tolist()]
    target.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return losses


FORMAT = Format(
    "coefficients of direct linear transformations: cameras, 11 rows",
    read=read,
    recognises_cameras=recognises_cameras,
    write_cameras=write_cameras,
)
