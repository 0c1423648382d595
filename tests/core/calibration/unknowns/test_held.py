"""What a calibration holds, as unknowns under wide priors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereophd.core.calibration.unknowns.held import LENS_STD, enlarge, with_unmeasured
from stereophd.core.calibration.unknowns.parameters import Parameter, ParameterSet
from stereophd.core.calibration.unknowns.quantities.base import IMAGES
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.lens import Lens
from tests.scenes import build_camera

PERIODS = np.array([0.1, 0.04])
# What nobody has measured of an image that is stated as makers state it.
OF_MAKERS = (*LENS_STD, "focal", "aspect", "principal_point_u", "principal_point_v")
TIMES_OF_RIGHT = ("right.readout", "right.clock_offset", "right.clock_rate")


def cameras(lens: Lens) -> tuple[Camera, ...]:
    left = build_camera("left", focal=900.0, middle=(400.0, 300.0))
    return left, replace(left, name="right", lens=lens)


def names(parameters: ParameterSet, places: np.ndarray) -> list[str]:
    return [parameters.names[place] for place in places]


def test_everything_but_the_unknowns_and_the_reference_clock_is_held() -> None:
    stated = ParameterSet(cameras(Lens()), (Parameter("focal", "right", 0.0, 0.01),))
    enlarged = enlarge(stated, 0, PERIODS)
    held = enlarged.parameters.names[1:]
    assert enlarged.parameters.names[0] == "right.focal"
    assert "left.focal" in held
    assert "right.clock_offset" in held
    assert not any(name.startswith("left.clock") for name in held)
    std = dict(zip(enlarged.parameters.names, enlarged.parameters.prior_std, strict=True))
    assert {name: std[f"right.{name}"] for name in LENS_STD} == LENS_STD
    assert std["right.readout"] == PERIODS[1]
    assert std["right.focal"] == 0.01


def test_absent_lenses_are_told_from_stated_ones() -> None:
    stated = ParameterSet(cameras(Lens("radial", k1=-0.1)), (Parameter("focal", "right", 0.0, 0.01),))
    lenses = [group for group in enlarge(stated, 0, PERIODS).groups if group.quantity == "distortion"]
    assert [group.is_unmeasured for group in lenses] == [True, False, False]
    # of a lens whose first coefficient is unknown the others are absent
    estimated = replace(stated, parameters=(Parameter("k1", "right", 0.0, 0.1),))
    lenses = [group for group in enlarge(estimated, 0, PERIODS).groups if group.quantity == "distortion"]
    assert lenses[1].names == ("right.k2", "right.p1", "right.p2")
    assert [group.is_unmeasured for group in lenses] == [True, True, True]


def test_images_that_nobody_has_measured_have_no_lens_and_their_middle_as_principal_point() -> None:
    left, right = cameras(Lens())
    known = (Parameter("focal", "right", 0.0, 0.01),)
    images, lens_of_right = [f"left.{name}" for name in OF_MAKERS], [f"right.{name}" for name in LENS_STD]
    times = ["left.readout", *TIMES_OF_RIGHT]
    measured = (
        replace(right, cx=right.cx + 2.0),
        replace(right, fy=880.0),
        replace(right, lens=Lens("radial", k1=0.1)),
    )
    for camera, lens in zip(measured, (lens_of_right, lens_of_right, []), strict=True):
        assert unmeasured_with_a_lens(ParameterSet((left, camera), known)) == sorted([*images, *lens, *times])
    both = [*images, *(f"right.{name}" for name in OF_MAKERS if name != "focal"), *times]
    assert unmeasured_with_a_lens(ParameterSet((left, right), known)) == sorted(both)
    assert unmeasured_with_a_lens(ParameterSet(measured[:1], known)) == sorted([*lens_of_right, "right.readout"])


def unmeasured_with_a_lens(stated: ParameterSet) -> list[str]:
    """What nobody has measured where the first lens is contradicted."""
    enlarged = enlarge(stated, 0, PERIODS)
    lens = next(group for group in enlarged.groups if group.quantity == "distortion")
    return sorted(names(enlarged.parameters, enlarged.unmeasured_with(lens)))


def test_who_has_not_compared_clocks_has_not_measured_images_that_are_stated_as_makers_state_them() -> None:
    left, right = cameras(Lens())
    enlarged = enlarge(ParameterSet((left, replace(right, lens=Lens("radial", k1=0.1))), ()), 0, PERIODS)
    clock = next(group for group in enlarged.groups if group.quantity == "clock_offset")
    assert clock.is_unmeasured
    unmeasured = names(enlarged.parameters, enlarged.unmeasured_with(clock))
    assert unmeasured == [*(f"left.{name}" for name in OF_MAKERS), "left.readout", *TIMES_OF_RIGHT]
    # what was measured and is wrong says nothing of the rest
    measured = enlarge(ParameterSet((left, replace(right, readout_s=0.01)), ()), 0, PERIODS)
    readout = next(group for group in measured.groups if group.names == ("right.readout",))
    assert names(measured.parameters, measured.unmeasured_with(readout)) == ["right.readout"]


def test_what_nobody_may_have_measured_is_unknown_from_the_beginning() -> None:
    left, right = cameras(Lens())
    known = (Parameter("focal", "right", 0.0, 0.01),)
    measured = replace(right, lens=Lens("radial", k1=0.1))
    images = [f"left.{name}" for name in OF_MAKERS]
    found = with_unmeasured(ParameterSet((left, measured), known), 0, PERIODS)
    assert found.names == ("right.focal", *images, "left.readout", *TIMES_OF_RIGHT)
    stated = replace(measured, readout_s=0.01)  # a shutter that was measured, and the reference's clock
    assert with_unmeasured(ParameterSet((stated,), known), 0, PERIODS[1:]).names == ("right.focal",)


def test_images_are_one_statement_where_no_camera_states_a_lens() -> None:
    left, right = cameras(Lens())

    def images(*stated: Camera) -> list[str]:
        enlarged = enlarge(ParameterSet(stated, (Parameter("focal", "right", 0.0, 0.01),)), 0, PERIODS)
        groups = [group for group in enlarged.groups if group.quantity == IMAGES]
        return [name for group in groups for name in names(enlarged.parameters, group.places)]

    of_right = [f"right.{name}" for name in OF_MAKERS if name != "focal"]
    assert sorted(images(left, right)) == sorted([*(f"left.{name}" for name in OF_MAKERS), *of_right])
    # who states a lens without distortion has measured it, as has who states different pixels
    assert images(left, replace(right, lens=Lens("radial"))) == []
    assert images(left, replace(right, fy=880.0)) == []


def test_what_is_freed_follows_the_unknowns() -> None:
    stated = ParameterSet(cameras(Lens()), (Parameter("focal", "right", 0.0, 0.01),))
    enlarged = enlarge(stated, 0, PERIODS)
    both = next(g for g in enlarged.groups if g.quantity == "distortion" and len(g.places) == 8)
    freed = enlarged.freed(stated, both.places)
    assert freed.names == ("right.focal", *(f"{camera}.{name}" for camera in ("left", "right") for name in LENS_STD))
    # the cameras are those of the statement, with a lens to estimate
    assert [camera.lens for camera in freed.build(np.zeros(9))] == [Lens("brown_conrady"), Lens("brown_conrady")]
    assert freed.build([0.0, -0.3, 0.1, *np.zeros(6)])[0].lens == Lens("brown_conrady", k1=-0.3, k2=0.1)
    clock = next(g for g in enlarged.groups if g.quantity == "clock_offset")
    assert enlarged.freed(stated, clock.places).cameras == stated.cameras


def test_a_frame_alone_has_no_period() -> None:
    enlarged = enlarge(ParameterSet(cameras(Lens()), (Parameter("focal", "right", 0.0, 0.01),)), 0, np.zeros(2))
    assert not any(name.endswith(("readout", "clock_offset")) for name in enlarged.parameters.names)
