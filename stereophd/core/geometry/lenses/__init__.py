"""Lens models: one module each, found by its name, the word of ``distortion.model``.

A module holds the model's settings, code and largest radius (`LENS`), and its formula as a plain function, which
`stereophd.core.geometry.compiled_lenses` compiles.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

from stereophd.core.geometry.lenses.base import LensModel
from stereophd.core.settings import members


@cache
def lens_models() -> Mapping[str, LensModel]:
    """Return every lens model by its name, in the order of the codes."""
    found = members(__name__, "LENS")
    return {name: found[name] for name in sorted(found, key=lambda name: found[name].code)}
