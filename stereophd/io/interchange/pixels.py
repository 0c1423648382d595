"""Pixels of other programs in native ones: where pixel (0, 0) lies, and from which side rows count."""

from __future__ import annotations

from stereophd.core.arrays import Array
from stereophd.errors import InputError
from stereophd.io.interchange.base import ForeignRecording, ImportOptions

#: What to subtract for the centre of the first pixel to be (0, 0).
ORIGINS = {"center": 0.0, "corner": 0.5, "one": 1.0}


def native_pixels(
    pixels: Array,
    camera: str,
    options: ImportOptions,
    recording: ForeignRecording,
    origin: str = "center",
    rows_from: str = "top",
) -> Array:
    """Return native pixels: (0, 0) is the centre of the top-left pixel, rows count from the top.

    Parameters
    ----------
    pixels
        Pixels (n, 2) of the source.
    camera
        Native name; where rows count from the bottom its image height must be known.
    options, recording
        The conventions that the user states, and the cameras that the source has.
    origin, rows_from
        The conventions of the format where the user states none: keys of `ORIGINS`, ``top`` or ``bottom``.

    Raises
    ------
    InputError
        Rows count from the bottom, and the height is not known.
    """
    shift = ORIGINS[options.pixel_origin or origin]
    if (options.rows_from or rows_from) == "top":
        return pixels - shift
    size = options.image_sizes.get(camera)
    if size is None and camera in recording.cameras:
        size = recording.cameras[camera].image_size_px
    if size is None:
        raise InputError(
            f"camera {camera}: expected the size of the images, for rows count from the bottom; found none; state it "
            "by `image_sizes`"
        )
    result = pixels - shift
    result[:, 1] = size[1] - 1 - result[:, 1]
    return result
