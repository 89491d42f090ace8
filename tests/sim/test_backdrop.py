"""Waves, clouds and the sea of pictures: smooth where they should be, and brighter the flatter water is looked at."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from kcal.sim import coast
from kcal.sim.coast import _random_lattice, smooth_noise


def test_noise_joins_its_random_values_smoothly() -> None:
    lattice = _random_lattice().reshape(256, 256)
    x, y = np.meshgrid(np.arange(5.0), np.arange(4.0))
    np.testing.assert_allclose(smooth_noise(x, y, 1), lattice[:4, :5])
    # It goes around, and on both sides of zero.
    np.testing.assert_allclose(smooth_noise(x - 256, y + 256, 1), lattice[:4, :5])
    np.testing.assert_allclose(smooth_noise(x - 5, y, 1), lattice[:4, -5:])
    # Between two values along a line of the lattice: 3 u² - 2 u³ of the way.
    for u in (0.2, 0.7):
        share = u * u * (3 - 2 * u)
        np.testing.assert_allclose(
            smooth_noise(x + u, y, 1), lattice[:4, :5] + share * np.diff(lattice[:4, :6]), atol=1e-6
        )
        down = np.diff(lattice[:5, :5], axis=0)
        np.testing.assert_allclose(smooth_noise(x, y + u, 1), lattice[:4, :5] + share * down, atol=1e-6)
    # No step anywhere.
    line = smooth_noise(np.linspace(0, 9, 9001), 0.37 + 0.2 * np.linspace(0, 9, 9001), 1)
    assert np.abs(np.diff(line)).max() < 4e-3


def test_octaves_have_half_the_weight_and_twice_the_detail() -> None:
    x = np.linspace(0, 5, 40)
    parts = [smooth_noise(x * 2**k + 17.3 * k, x * 2**k + 5.1 * k, 1) for k in range(3)]
    np.testing.assert_allclose(smooth_noise(x, x, 3), (parts[0] + parts[1] / 2 + parts[2] / 4) / 1.75, atol=1e-6)
    assert smooth_noise(np.zeros((2, 1)), np.zeros(3)).shape == (2, 3)


def test_water_mirrors_the_sky_more_the_flatter_it_is_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coast, "smooth_noise", lambda x, y, octaves: np.zeros_like(x))
    haze = SimpleNamespace(color=np.array([200.0, 210.0, 220.0]), seen=lambda color, distance: color)
    shore = SimpleNamespace(water=(40.0, 60.0, 80.0), haze=haze)
    down = np.array([0.0, -0.05, -1.0])
    heading = np.stack([np.sqrt(1 - down**2), 0 * down, down], -1)[:, None] * np.ones((1, 2, 1))
    camera = SimpleNamespace(center=(0.0, 0.0, 10.0))
    found = coast._sea(camera, heading, np.ones((3, 2)), shore)[:, 0]  # type: ignore[arg-type]
    for color, share in zip(found, 0.45 * np.exp(down / 0.05), strict=True):
        np.testing.assert_allclose(color, np.array(shore.water) + share * (haze.color - shore.water))


def test_values_of_every_fourth_pixel_are_joined_by_lines() -> None:
    few = np.add.outer(10.0 * np.arange(4), np.arange(3.0))
    found = coast._joined_values(few, (13, 9))
    np.testing.assert_allclose(found, np.add.outer(2.5 * np.arange(13), 0.25 * np.arange(9)))
    # Beyond the last one nothing changes.
    np.testing.assert_allclose(coast._joined_values(few, (15, 11))[12:, 8:], found[12, 8])
