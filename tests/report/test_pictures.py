"""Pictures of reports: boards, every picture, and marks that are small."""

import functools
import itertools
from typing import Any

import numpy as np
import pytest
import torch
from calibrate_scenes import BOARD
from drawn_scenes import FIGURES, bent, boxes, calibrated, landmarks_rig, sites
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver, QuiverKey

from kcal import CalibrationOptions, Camera, Observations, calibrate_camera
from kcal.calibrate.camera.advice import unreached_share
from kcal.calibrate.camera.export import Misfit
from kcal.calibrate.hybrid.measured_board import board_text
from kcal.lens import camera_difference
from kcal.locate.siting import siting_map
from kcal.report import rig_figure
from kcal.report.calibration import (
    calibration_figure,
    coverage_figure,
    difference_figure,
    draw_coverage,
    gallery_figure,
)
from kcal.report.positions import _sigma_levels

# Pictures of cameras: no title is cut, panels fill the page, and they say the same as the commands do.


LONG = "/home/somebody/a long folder of a site/with the date 2026-11-24/and more of it/rig.json: the left camera"


def observed(count: int = 8) -> Observations:
    seen, spread = calibrated().observations, {"covariance": ((0.01, 0.0, 0.01),) * BOARD.corners}
    return seen.model_copy(update={"views": tuple(view.model_copy(update=spread) for view in seen.views[:count])})


def widths(figure: Figure) -> list[float]:
    """Right ends of all texts of the figure, as shares of its width; drawn beyond 1 is cut."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    wide = figure.get_window_extent().width
    return [text.get_window_extent(canvas.get_renderer()).x1 / wide for text in figure.texts]


@pytest.mark.parametrize("size", [(640, 480), (1920, 400), (480, 1600)])
def test_a_misfit_has_its_whole_title_and_fills_its_page(size: tuple[int, int]) -> None:
    pixels = Camera.build(focal=(900, 900), center=(300, 200), size=size).grid(33, 25)
    misfit = Misfit(model="opencv4", pixels=pixels, shift=torch.full_like(pixels, 0.3))
    figure = difference_figure(misfit, LONG, ["opencv4: RMS 0.4 px, " + "and so on, " * 30])
    assert LONG.split("/")[-1][-15:] in "".join(text.get_text().replace("\n", " ") for text in figure.texts)
    assert max(widths(figure)) < 1.0
    image = figure.axes[0].get_position()
    wide, tall = image.width * figure.get_figwidth(), image.height * figure.get_figheight()
    # The axes have the image's shape, so that nothing is left empty around it.
    assert wide / tall == pytest.approx(size[0] / size[1], rel=0.01)


def test_places_up_to_the_edges_are_of_an_image_of_that_size() -> None:
    """Half a pixel beyond the centers of the outermost pixels: the image is no pixel larger."""
    x, y = torch.linspace(-0.5, 639.5, 33).double(), torch.linspace(-0.5, 479.5, 25).double()
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)
    figure = difference_figure(Misfit(model="opencv4", pixels=pixels, shift=torch.full_like(pixels, 0.3)), "", [])
    assert figure.axes[0].get_xlim() == (-0.5, 639.5)
    assert figure.axes[0].get_ylim() == (479.5, -0.5)


def test_a_view_that_was_left_out_has_no_arrows() -> None:
    seen = observed()
    twice = seen.model_copy(update={"views": (*seen.views, seen.views[0].model_copy(update={"name": "copy.png"}))})
    figure = calibration_figure(calibrate_camera(twice, CalibrationOptions(model="opencv4")), "left")
    (drawn,) = [part for part in figure.axes[0].collections if isinstance(part, Quiver)]
    assert len(drawn.U) == 8 * BOARD.corners
    assert figure.texts[0].get_text().startswith("left: 8 of 9 views")


def test_the_share_that_boards_reached_is_everywhere_the_same() -> None:
    seen = observed()
    text = coverage_figure(seen).texts[0].get_text()
    assert f"boards reached {100 * (1 - unreached_share(seen)):.0f} % of the image" in text


def test_a_gallery_is_in_order_after_what_stands_out() -> None:
    seen = observed(6)
    views = list(seen.views)
    views[4] = views[4].model_copy(update={"covariance": tuple((0.09, 0.0, 0.09) for _ in range(BOARD.corners))})
    views[2] = views[2].model_copy(
        update={"pixels": (None, *views[2].pixels[1:]), "covariance": (None, *views[2].covariance[1:])}
    )
    # A little more uncertain than others is nothing.
    views[3] = views[3].model_copy(update={"covariance": tuple((0.011, 0.0, 0.011) for _ in range(BOARD.corners))})
    figure = gallery_figure(seen.model_copy(update={"views": tuple(views)}))
    order = [axes.get_title(loc="left")[:2] for axes in figure.axes]
    assert order == ["02", "04", "00", "01", "03", "05"]
    assert "the first 2 stand out" in figure.texts[0].get_text()
    assert "stand" not in gallery_figure(seen).texts[0].get_text()


# The picture of a measured board.


def test_text_of_a_flat_board() -> None:
    lines = board_text(bent(0.0))
    assert lines[0].startswith("bending 0.000 ± 0.0")
    assert [line.split()[0] for line in lines] == ["bending", "stretch", "shear", "print"]


# Every picture: nothing is cut, nothing covers another thing, nothing is lost in a corner.


# Points of data stand where they are: their names may meet.
_DATA = {"positions", "rig", "wide rig", "stations", "sites", "stars"}


@functools.cache
def drawn(name: str) -> tuple[tuple[int, int], list[tuple[str, Any]], list[Any]]:
    """Width and height of a figure, texts with their boxes, and boxes of axes, in pixels."""
    figure = FIGURES[name]()
    return figure.canvas.get_width_height(), *boxes(figure)


@pytest.mark.parametrize("name", FIGURES)
def test_no_text_is_cut(name: str) -> None:
    (wide, tall), texts, _ = drawn(name)
    cut = [text for text, box in texts
           if box.x0 < -2 or box.y0 < -2 or box.x1 > wide + 2 or box.y1 > tall + 2]  # fmt: skip
    assert cut == []


@pytest.mark.parametrize("name", FIGURES)
def test_no_axes_cover_each_other(name: str) -> None:
    (wide, tall), _, axes = drawn(name)
    for box in axes:
        assert -1 <= box.x0 < box.x1 <= wide + 1
        assert -1 <= box.y0 < box.y1 <= tall + 1
    for one, other in itertools.combinations(axes, 2):
        assert min(min(one.x1, other.x1) - max(one.x0, other.x0), min(one.y1, other.y1) - max(one.y0, other.y0)) < 1
    # Most of the page is used.
    assert sum(box.width * box.height for box in axes) > 0.3 * wide * tall


@pytest.mark.parametrize("name", FIGURES)
def test_no_text_covers_another(name: str) -> None:
    _, texts, _ = drawn(name)
    covered = []
    for (first, one), (second, other) in itertools.combinations(texts, 2):
        across = min(one.x1, other.x1) - max(one.x0, other.x0)
        down = min(one.y1, other.y1) - max(one.y0, other.y0)
        small = min(one.height, other.height)
        if across > 2 and down > 0.35 * small and first != second:
            covered.append((first[:40], second[:40]))
    assert len(covered) <= (3 if name in _DATA else 0), covered


@pytest.mark.parametrize("kind", ["rig", "difference"])
def test_pictures_for_a_phone_are_narrow_and_whole(kind: str) -> None:
    result = calibrated()
    other = result.camera.with_parameters(result.camera.params + 0.5)
    figure = (
        rig_figure(landmarks_rig(), narrow=True)
        if kind == "rig"
        else difference_figure(camera_difference(result.camera, other), "june and december", narrow=True)
    )
    # A screen of 390 px shows letters of 9 points, an eighth of an inch, at 9 px or more.
    assert figure.get_figwidth() < 4.9
    texts, _ = boxes(figure)
    wide, tall = figure.canvas.get_width_height()
    assert [text for text, box in texts if box.x0 < -2 or box.y0 < -2 or box.x1 > wide + 2 or box.y1 > tall + 2] == []
    first, second = (axes.get_window_extent() for axes in figure.axes)
    assert second.y1 < first.y0


# Arrows of pictures: of a plan's north, and of residuals, as long as there is room; levels of very small errors.


def test_a_typical_residual_is_a_sixtieth_of_the_image() -> None:
    result = calibrated()
    axes = Figure().add_subplot()
    draw_coverage(axes, result)
    (drawn,) = [part for part in axes.collections if isinstance(part, Quiver)]
    error = -result.residuals.numpy().reshape(-1, 2)
    scale = 640 / 60 / np.sqrt((error**2).mean())
    # The bar above says how long a residual is: the longest round one in an eighth of the width.
    (key,) = [part for part in axes.artists if isinstance(part, QuiverKey)]
    assert scale * float(key.label.removesuffix(" px")) == pytest.approx(key.U)
    assert 0.4 * 0.12 * 640 < key.U <= 0.12 * 640
    np.testing.assert_allclose(np.stack([drawn.U, drawn.V], -1), scale * error)


def test_levels_below_a_millimeter() -> None:
    area, towers, _ = sites()
    found = siting_map(area, towers)
    assert _sigma_levels([found._replace(sigma=1e-7 * found.sigma)]) == pytest.approx([1e-3, 2e-3, 5e-3])
