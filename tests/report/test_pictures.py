"""Pictures of cameras: no title is cut, panels fill the page, and they say the same as the commands do."""

from __future__ import annotations

import pytest
import torch
from calibrate_scenes import BOARD, camera, motions
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver

from kcal.calibrate.camera.advice import unreached_share
from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.camera.export import Misfit
from kcal.corners.observations import Observations, View
from kcal.lens.camera import Camera
from kcal.lens.difference import camera_difference
from kcal.report.calibration import (
    calibration_figure,
    coverage_figure,
    difference_figure,
    difference_text,
    gallery_figure,
)

LONG = "/home/somebody/a long folder of a site/with the date 2026-11-24/and more of it/rig.json: the left camera"


def observed(count: int = 8) -> Observations:
    truth = camera("opencv4")
    rotation, translation = motions(truth, count, 3)
    pixels, _ = truth.project(BOARD.points @ rotation.transpose(-1, -2) + translation[:, None])
    noise = 0.05 * torch.randn(pixels.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    spread = tuple((0.01, 0.0, 0.01) for _ in range(BOARD.corners))
    views = [
        View(name=f"{i:02}.png", pixels=tuple(map(tuple, view)), covariance=spread)
        for i, view in enumerate((pixels + noise).tolist())
    ]
    return Observations(board=BOARD, image_size=(640, 480), views=tuple(views))


def widths(figure: Figure) -> list[float]:
    """Right ends of all texts of the figure, as shares of its width; drawn beyond 1 is cut."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    wide = figure.get_window_extent().width
    return [text.get_window_extent(canvas.get_renderer()).x1 / wide for text in figure.texts]


def filled(figure: Figure) -> float:
    """Share of the figure's height from the lowest axis to the highest."""
    boxes = [axes.get_position() for axes in figure.findobj(Axes)]
    return max(box.y1 for box in boxes) - min(box.y0 for box in boxes)


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


def test_a_difference_fills_its_page() -> None:
    left = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480))
    right = Camera.build(focal=(810, 800), center=(321, 240), size=(640, 480))
    found = camera_difference(left, right)
    figure = difference_figure(found, "june and december", difference_text(found))
    # Below 0.5 where the image did not have the shape of its axes.
    assert filled(figure) > 0.65
    assert max(widths(figure)) < 1.0


def test_the_picture_of_a_camera_names_it() -> None:
    result = calibrate_camera(observed(), CalibrationOptions(model="opencv4"))
    (title,) = [text.get_text() for text in calibration_figure(result, "left").texts]
    assert title.startswith("left: 8 views")


def test_a_view_that_was_left_out_has_no_arrows() -> None:
    seen = observed()
    twice = seen.model_copy(update={"views": (*seen.views, seen.views[0].model_copy(update={"name": "copy.png"}))})
    result = calibrate_camera(twice, CalibrationOptions(model="opencv4"))
    figure = calibration_figure(result, "left")
    (drawn,) = [part for part in figure.axes[0].collections if isinstance(part, Quiver)]
    assert len(drawn.U) == 8 * BOARD.corners
    assert figure.texts[0].get_text().startswith("left: 8 of 9 views")


def test_the_share_that_boards_reached_is_everywhere_the_same() -> None:
    seen = observed()
    text = coverage_figure(seen).axes[0].get_title(loc="left")
    assert f"boards reached {100 * (1 - unreached_share(seen)):.0f} % of the image" in text


def test_a_gallery_is_in_order_after_what_stands_out() -> None:
    seen = observed(6)
    views = list(seen.views)
    assert views[2].covariance is not None
    blurred = tuple((0.09, 0.0, 0.09) for _ in range(BOARD.corners))
    views[4] = views[4].model_copy(update={"covariance": blurred})
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
