"""Lens models: one module each, found by its name, the word of ``distortion.model``.

A module holds the settings of its model, its code and its largest radius (`LENS`). Modules `brown_conrady` and
`fisheye` also hold the radial formula of their model as a plain function, `scale`; `radial` is the case of
`brown_conrady` with one coefficient. `stereophd.core.geometry.compiled_lenses` compiles the formulas; the tangential
terms and the inverse are there.
"""

from collections.abc import Mapping
from functools import cache

from stereophd.core.geometry.lenses.base import LensModel
from stereophd.core.settings import members


@cache
def lens_models() -> Mapping[str, LensModel]:
    """Return every lens model by its name, in the order of the codes."""
    lenses = members(__name__, "LENS")
    return {name: lenses[name] for name in sorted(lenses, key=lambda name: lenses[name].code)}
