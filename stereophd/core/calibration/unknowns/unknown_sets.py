"""Sets of unknowns: those that are freed stage by stage.

A wrong clock looks like a wrong pose, and a wrong principal point like a turn of the camera. If everything is free from
the start, an adjustment to a rough association distorts the unknowns that the association does not determine. So the
first stage frees what fixes the frame (poses, clocks, rates), the second focal lengths and k1, the third the rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Booleans
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.calibration.unknowns.quantities.base import MOVES


@dataclass(frozen=True)
class UnknownSet:
    """Some of the unknowns; the others are held."""

    free: Booleans  # (m,) of bool: Which values of the parameter set are free
    names: tuple[str, ...]  # Components that are free, each once, in the order of the parameters


def _named(parameters: ParameterSet, names: Sequence[str]) -> Booleans:
    """Values whose component or quantity has one of the names."""
    return np.array([p.name in names or p.quantity.name in names for p in parameters.parameters])


def _distinct(parameters: ParameterSet, masks: Sequence[Booleans]) -> tuple[UnknownSet, ...]:
    """Sets of the masks that are not empty, each once."""
    found: list[UnknownSet] = []
    for mask in masks:
        if mask.any() and not any((mask == other.free).all() for other in found):
            names = [p.name for p, free in zip(parameters.parameters, mask, strict=True) if free]
            found.append(UnknownSet(mask, tuple(dict.fromkeys(names))))
    return tuple(found)


def default_stages(parameters: ParameterSet) -> tuple[UnknownSet, ...]:
    """Poses and clocks; then focal lengths and k1; then the rest: those that have an unknown."""
    frame = np.array([p.quantity.of_the_frame or p.quantity.affects == MOVES for p in parameters.parameters])
    early = frame | _named(parameters, ("focal", "k1"))
    return _distinct(parameters, (frame, early, np.ones(parameters.size, dtype=np.bool_)))


def stages_named(parameters: ParameterSet, stages: Sequence[Sequence[str]]) -> tuple[UnknownSet, ...]:
    """Stages that free the named components or quantities one after the other, and at last all.

    Raises ValueError when a name is no unknown; the message lists them.
    """
    known = {p.name for p in parameters.parameters} | {p.quantity.name for p in parameters.parameters}
    free = np.zeros(parameters.size, dtype=np.bool_)
    masks = []
    for names in stages:
        for name in names:
            if name not in known:
                raise ValueError(f"expected unknowns of the priors ({', '.join(sorted(known))}), found {name}")
        free = free | _named(parameters, names)
        masks.append(free)
    return _distinct(parameters, (*masks, np.ones(parameters.size, dtype=np.bool_)))
