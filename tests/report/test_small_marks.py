"""Arrows of pictures: of a plan's north, and of residuals, as long as there is room; levels of very small errors."""

from __future__ import annotations

import numpy as np
import pytest
from drawn_scenes import calibrated, landmarks_rig, sites
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver

from kcal.locate.siting import siting_map
from kcal.report.calibration import draw_coverage
from kcal.report.positions import _sigma_levels
from kcal.report.rig import rig_figure


def test_north_is_up() -> None:
    plan = rig_figure(landmarks_rig()).axes[0]
    (arrow,) = [text for text in plan.texts if getattr(text, "xycoords", "") == "axes fraction"]
    assert (arrow.xy, arrow.xyann) == ((0.04, 1.0), (0.04, 0.89))


def test_a_typical_residual_is_a_sixtieth_of_the_image() -> None:
    result = calibrated()
    axes = Figure().add_subplot()
    draw_coverage(axes, result.observations, result)
    (drawn,) = [part for part in axes.collections if isinstance(part, Quiver)]
    error = -result.residuals.numpy().reshape(-1, 2)
    scale = float(axes.get_title(loc="left").rpartition("x ")[2])
    wanted = 640 / 60 / np.sqrt((error**2).mean())
    # The round factor at or below it.
    assert 0.4 * wanted < scale <= wanted
    np.testing.assert_allclose(np.stack([drawn.U, drawn.V], -1), scale * error)


def test_levels_below_a_millimeter() -> None:
    area, towers, _ = sites()
    found = siting_map(area, towers)
    tiny = found._replace(sigma=1e-7 * found.sigma)
    assert _sigma_levels([tiny]) == pytest.approx([1e-3, 2e-3, 5e-3])
