"""Every lens model, found by its name, keeps the contract of a lens."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from stereophd.core.geometry.lens import SLOTS, Lens
from stereophd.core.geometry.lenses import lens_models

# A distortion of a few per cent at the edge of the image.
SMALL = 0.02


def small_lens(word: str) -> Lens:
    """A lens whose coefficients all count."""
    names = lens_models()[word].coefficients
    return Lens(word, **{name: SMALL / (number + 1) for number, name in enumerate(names)})


@pytest.mark.parametrize("word", list(lens_models()))
class TestEveryLens:
    def test_its_word_is_the_name_of_its_module(self, word: str) -> None:
        model = lens_models()[word]
        assert model.settings.__module__ == f"stereophd.core.geometry.lenses.{word}"
        assert {field.name: field.default for field in dataclasses.fields(model.settings)}["model"] == word

    def test_its_coefficients_fit_a_packed_camera(self, word: str) -> None:
        model = lens_models()[word]
        assert len(model.coefficients) <= SLOTS
        assert set(model.coefficients) <= {field.name for field in dataclasses.fields(Lens)}
        assert [other.code for other in lens_models().values()].count(model.code) == 1

    def test_points_come_back(self, word: str) -> None:
        lens = small_lens(word)
        xy = np.random.default_rng(3).uniform(-0.5, 0.5, (200, 2))
        np.testing.assert_allclose(lens.undistort(lens.distort(xy)[0])[0], xy, atol=1e-12)

    def test_its_jacobian_is_its_derivative(self, word: str) -> None:
        lens, step = small_lens(word), 1e-6
        xy = np.random.default_rng(4).uniform(-0.5, 0.5, (50, 2))
        for axis in range(2):
            shift = step * np.eye(2)[axis]
            numeric = (lens.distort(xy + shift)[0] - lens.distort(xy - shift)[0]) / (2 * step)
            np.testing.assert_allclose(lens.distort(xy)[1][:, :, axis], numeric, atol=1e-9)

    def test_its_radial_map_grows_up_to_its_largest_radius(self, word: str) -> None:
        names = lens_models()[word].coefficients[:1]
        lens = Lens(word, **dict.fromkeys(names, -0.3))
        edge = min(lens.max_radius, 3.0)
        radii = np.linspace(0.0, edge, 400)
        assert (np.diff(lens.distort(np.column_stack([radii, 0 * radii]))[0][:, 0]) > 0).all()
