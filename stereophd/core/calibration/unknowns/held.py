"""What is stated as known of the cameras, as unknowns under wide default priors.

Makers state no lens, a focal length of the data sheet, the middle of the image. Whether the data contradict that, and
how far an answer moves if it is not quite so, are questions to one set of unknowns in which everything is free
(`calibration.adjustment.suspicions`). Who measures an image measures its lens, focal length, aspect and principal point
together, and compares clocks: where one of them that nobody may have measured is contradicted, all of them are unknown
under these priors. A lens has more than k1: what k1 and the principal point took up of the rest would be stated as far
more certain than it is. A log of which all images are as makers state them has to show that they are exact, as hardly
any is: else they are unknown, too.
"""

from dataclasses import dataclass, replace

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.unknowns.parameters import Parameter, ParameterSet
from stereophd.core.calibration.unknowns.quantities.base import IMAGES
from stereophd.core.calibration.unknowns.quantities.registry import quantities
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.lens import PARAMETERS, Lens

# Standard deviations of what is stated as known: of coefficients of the lens, of the logarithms of focal length and
# aspect, of the principal point in widths of the image, of the readout and the clock's offset in periods of the frames,
# of the clock's rate.
LENS_STD = {"k1": 0.3, "k2": 0.15, "p1": 1e-3, "p2": 1e-3}
FOCAL_STD, ASPECT_STD, PRINCIPAL_POINT_WIDTHS, PERIODS, RATE_STD = 0.03, 5e-3, 0.015, 1.0, 1e-3
# Odds, before the data, that a statement is wrong: of what is absent, of any other value.
ABSENT_ODDS, STATED_ODDS = 0.1, 1e-3
# What makers state of an image, a lens first; the middle is stated to half a pixel.
IMAGE, MIDDLE_PX = ("distortion", "focal", "aspect", "principal_point"), 0.5


@dataclass(frozen=True)
class HeldGroup:
    """Unknowns that explain a kind of contradiction: a quantity of one camera or of all, or all that is unmeasured."""

    quantity: str
    names: tuple[str, ...]  # Of its values.
    places: Integers  # Where they are in the enlarged set.
    odds: float  # Before the data, that the values are not as stated.
    is_unmeasured: bool  # Whether nobody may have measured it: what is absent, and the image that makers state.


@dataclass(frozen=True)
class EnlargedSet:
    """The unknowns of a calibration, and after them everything that it holds."""

    parameters: ParameterSet
    groups: tuple[HeldGroup, ...]

    def freed(self, known: ParameterSet, places: Integers) -> ParameterSet:
        """Return the unknowns of the calibration together with some of those that it holds."""
        more = tuple(self.parameters.parameters[i] for i in places.tolist())
        lenses = {parameter.camera for parameter in more if parameter.quantity.name == "distortion"}
        each = zip(self.parameters.cameras, known.cameras, strict=True)
        cameras = tuple(own if own.name in lenses else stated for own, stated in each)
        return replace(known, cameras=cameras, parameters=(*known.parameters, *more))

    def unmeasured_with(self, group: HeldGroup | None = None) -> Integers:
        """Places of all that nobody has measured, also if a group of that is unknown; those of another group alone."""
        if group is not None and not group.is_unmeasured:
            return group.places
        places = [one.places for one in self.groups if one.is_unmeasured]
        return np.unique(np.concatenate([np.empty(0, np.int64), *places]))


def is_of_maker(camera: Camera) -> bool:
    """Whether an image is stated as makers state it: no lens, square pixels, its middle as the principal point."""
    middle = np.array([camera.cx - (camera.width - 1) / 2.0, camera.cy - (camera.height - 1) / 2.0])
    is_plain = not camera.lens.coefficients.any() and camera.fx == camera.fy
    return is_plain and bool((np.abs(middle) <= MIDDLE_PX).all())


def enlarge(parameters: ParameterSet, reference: int, periods: Array) -> EnlargedSet:
    """Return the unknowns of a calibration and, under wide priors, what it holds of lenses, images and clocks.

    The clock of the reference camera fixes that of the results; `periods` (c,) are median times between two frames, s.
    """
    cameras = [
        replace(c, lens=Lens("brown_conrady", k1=c.lens.k1)) if c.lens.model in ("none", "radial") else c
        for c in parameters.cameras
    ]
    size, extra, groups = parameters.size, list[Parameter](), list[HeldGroup]()
    by_quantity: dict[str, list[HeldGroup]] = {}
    for number, camera in enumerate(cameras):
        of_times = {"clock_offset": 0.0, "clock_rate": camera.clock.rate - 1.0, "readout": camera.readout_s}
        for quantity, stds in _wide_priors(camera, float(periods[number]), number == reference).items():
            names = [name for name, std in stds.items() if std > 0.0 and parameters.index(camera.name, [name])[0] < 0]
            if not names:
                continue
            places = np.arange(size + len(extra), size + len(extra) + len(names))
            extra += [Parameter(name, camera.name, 0.0, stds[name]) for name in names]
            stated = [of_times.get(name, getattr(camera.lens, name, 0.0)) for name in names]
            is_absent = quantity not in IMAGE[1:] and not any(stated)
            odds = ABSENT_ODDS if is_absent else STATED_ODDS
            is_unmeasured = is_absent or (quantity in IMAGE and is_of_maker(camera))
            group = HeldGroup(quantity, tuple(f"{camera.name}.{name}" for name in names), places, odds, is_unmeasured)
            by_quantity.setdefault(quantity, []).append(group)
    for quantity, each in by_quantity.items():
        groups += [*each, *([_together(quantity, each)] if len(each) > 1 else [])]
    unmeasured = [group for each in by_quantity.values() for group in each if group.is_unmeasured]
    if len({group.quantity for group in unmeasured}) > 1:
        groups.append(_together("unmeasured", unmeasured))
    images = [group for group in unmeasured if group.quantity in IMAGE]
    if images and all(is_of_maker(c) and c.lens.model == "none" for c in parameters.cameras):
        groups.append(_together(IMAGES, images))
    return EnlargedSet(ParameterSet(tuple(cameras), (*parameters.parameters, *extra)), tuple(groups))


def _together(quantity: str, groups: list[HeldGroup]) -> HeldGroup:
    """Return several groups as one, no more probably wrong than each."""
    names, places = tuple(name for group in groups for name in group.names), [group.places for group in groups]
    odds, is_unmeasured = min(group.odds for group in groups), all(group.is_unmeasured for group in groups)
    return HeldGroup(quantity, names, np.concatenate(places), odds, is_unmeasured)


def with_unmeasured(parameters: ParameterSet, reference: int, periods: Array) -> ParameterSet:
    """Return the unknowns of a calibration, and all that nobody may have measured, under wide priors."""
    enlarged = enlarge(parameters, reference, periods)
    return enlarged.freed(parameters, enlarged.unmeasured_with())


def _wide_priors(camera: Camera, period: float, is_reference: bool) -> dict[str, dict[str, float]]:
    """Standard deviations by quantity and component of what may be misstated of a camera."""
    wide = {
        "distortion": {name: std for name, std in LENS_STD.items() if name in PARAMETERS[camera.lens.model]},
        "focal": {"focal": FOCAL_STD},
        "aspect": {"aspect": ASPECT_STD},
        "principal_point": dict.fromkeys(
            ("principal_point_u", "principal_point_v"), PRINCIPAL_POINT_WIDTHS * camera.width
        ),
        "readout": {"readout": PERIODS * period},
        "clock_offset": {"clock_offset": PERIODS * period},
        "clock_rate": {"clock_rate": RATE_STD},
    }
    of_the_frame = {quantity.name for quantity in quantities() if quantity.of_the_frame}
    return {name: stds for name, stds in wide.items() if not (is_reference and name in of_the_frame)}
