"""What the next pictures should show: each sentence of advice where it belongs, and nowhere else."""

import math

import pytest
import torch
from torch import Tensor

from kcal import Board, Camera, Observations, View
from kcal.calibrate.camera.advice import (
    board_rolls,
    board_tilts,
    roll_findings,
    roll_span,
    unreached_share,
    what_to_photograph,
)
from kcal.calibrate.camera.warnings import corner_pupil, pupil_findings
from kcal.finding import sentences
from kcal.lens import LensModel, rotation_from_vector
from kcal.lens.model import HybridForm
from kcal.lens.zernike import ZernikeModes

BOARD = Board(columns=2, rows=2, square=0.1)


def seen(*boxes: tuple[float, float, float, float], size: tuple[int, int] = (300, 300)) -> Observations:
    """Views whose four corners are those of boxes: left, top, right, bottom."""
    views = tuple(
        View(name=str(number), pixels=((left, top), (right, top), (left, bottom), (right, bottom)))
        for number, (left, top, right, bottom) in enumerate(boxes)
    )
    return Observations(board=BOARD, image_size=size, views=views)


def turned(*, rolls: list[float], tilts: list[float] | None = None) -> Tensor:
    """Boards that are rolled, and then tilted about the horizontal."""
    zeros = [0.0] * len(rolls)
    roll = rotation_from_vector(torch.deg2rad(torch.tensor([[0.0, 0.0, one] for one in rolls]).double()))
    tilt = rotation_from_vector(torch.deg2rad(torch.tensor([[one, 0.0, 0.0] for one in tilts or zeros]).double()))
    return tilt @ roll


def camera() -> Camera:
    return Camera.build(focal=(300, 300), center=(149.5, 149.5), size=(300, 300), model="pinhole")


EVERYWHERE = [(-1.0, -1.0, 300.0, 300.0)] * 10
TILTED = turned(rolls=[0, 90, 30, 60, 0, 90, 0, 0, 10, 20], tilts=[30, 30, 30, 30, 0, 0, 0, 0, 0, 0])


def test_parts_that_boards_reached() -> None:
    assert unreached_share(seen((-1, -1, 149.5, 300))) == pytest.approx(0.5, abs=0.01)
    assert unreached_share(seen((-1, -1, 49.5, 50), size=(100, 50))) == pytest.approx(0.5, abs=0.01)


def test_two_corners_reach_nothing() -> None:
    view = View(name="a", pixels=((0.0, 0.0), (200.0, 0.0), None, None))
    assert unreached_share(Observations(board=BOARD, image_size=(300, 300), views=(view,))) == 1.0


def test_nothing_is_left_to_say() -> None:
    assert what_to_photograph(seen(*EVERYWHERE), camera(), TILTED) == ()


def test_few_views_and_tilts() -> None:
    few = what_to_photograph(seen(*EVERYWHERE[:9]), camera(), TILTED[:9])
    assert few == ("take more views: 9 are few, 20 to 40 are good",)
    left_out = torch.cat([TILTED[:9], torch.full((1, 3, 3), torch.nan).double()])
    assert what_to_photograph(seen(*EVERYWHERE), camera(), left_out) == few
    flat = turned(rolls=[0, 90, 30, 60, 0, 90, 0, 0, 10, 20], tilts=[30, 30, 30, 19, 0, 0, 0, 0, 0, 0])
    (tilts,) = what_to_photograph(seen(*EVERYWHERE), camera(), flat)
    assert tilts.startswith("tilt the board by 30 to 45 degrees")


def test_rolls() -> None:
    (rolls,) = what_to_photograph(seen(*EVERYWHERE), camera(), turned(rolls=[*[0.0] * 9, 59.0], tilts=[30.0] * 10))
    assert "so far within 59 degrees" in rolls
    assert what_to_photograph(seen(*EVERYWHERE), camera(), turned(rolls=[*[0.0] * 9, 61.0], tilts=[30.0] * 10)) == ()
    # The largest gap between them is what they leave; around the back too.
    for angles, span in (([10, 20, 40], 30), ([-170, 170], 20), ([0, 180], 180), ([-100, 0, 100], 200), ([7], 0)):
        assert roll_span(turned(rolls=[float(a) for a in angles])) == pytest.approx(span, abs=1e-4)
    assert roll_span(turned(rolls=[0.0])[:0]) == 0.0
    assert board_rolls(turned(rolls=[-30.0, 170.0])).tolist() == pytest.approx([-30.0, 170.0])
    assert board_tilts(turned(rolls=[20.0, 0.0, 0.0], tilts=[35.0, -50.0, 170.0])).tolist() == pytest.approx(
        [35, 50, 10]
    )


def test_boards_all_the_same_way_up() -> None:
    left_out = torch.full((1, 3, 3), torch.nan).double()
    tilted = turned(rolls=[-10.0, 15.0, 179.0], tilts=[30.0, -25.0, 20.0])
    (text,) = sentences(roll_findings(torch.cat([tilted, left_out])))
    assert text.startswith("all 3 views show the board upright (rolled by at most 15°)")
    assert text.endswith("turn the board or the camera by 90° for a third of the views")
    (text,) = sentences(roll_findings(turned(rolls=[80.0, -90.0, 105.0])))
    assert text.startswith("all 3 views show the board on its side (rolled by at most 15°)")
    assert roll_findings(turned(rolls=[0.0, 21.0])) == []
    assert len(roll_findings(turned(rolls=[0.0, 19.0]))) == 1
    assert roll_findings(turned(rolls=[0.0, 90.0])) == []
    assert roll_findings(left_out) == []


@pytest.mark.parametrize(
    ("box", "place"),
    [
        ((105, -1, 300, 300), "top left, left, bottom left"),
        ((-1, -1, 300, 195), "bottom left, bottom, bottom right"),
        ((-1, -1, 195, 195), "corners and along the sides"),
        ((140, 140, 160, 160), "middle, the corners and along the sides"),
    ],
)
def test_where_no_board_was(box: tuple[float, float, float, float], place: str) -> None:
    (text,) = what_to_photograph(seen(*[box] * 10), camera(), TILTED)
    assert text.startswith(f"show the board in the {place} of the image")


def test_a_corner_alone() -> None:
    (text,) = what_to_photograph(seen(*[(-1, -1, 195, 300), (-1, -1, 300, 195)] * 5), camera(), TILTED)
    assert text.startswith("show the board in the bottom right of the image")
    # A tenth of the image is not worth a picture.
    assert what_to_photograph(seen(*[(-1, -1, 275, 300)] * 10), camera(), TILTED) == ()


def hybrid(pupil1: float, focal: float = 300.0) -> tuple[Camera, Tensor]:
    model = LensModel(hybrid=HybridForm(shape=1.0, radius=1.0, modes=ZernikeModes()))
    parameters = torch.zeros(5 + model.size).double()
    parameters[:4] = torch.tensor([focal, focal, 149.5, 149.5])
    place = Camera(parameters, size=(300, 300), model=model).names.index("pupil1")
    parameters[place] = pupil1
    covariance = torch.zeros(len(parameters), len(parameters)).double()
    covariance[place, place] = 1e-4
    return Camera(parameters, size=(300, 300), model=model), covariance


def test_an_entrance_pupil_that_no_lens_has() -> None:
    assert corner_pupil(camera(), torch.eye(5)) is None
    assert pupil_findings(camera(), torch.eye(5)) == []
    corner = math.atan(math.hypot(149.5, 149.5) / 300)
    for slope in (0.1, -0.1):
        found = corner_pupil(*hybrid(slope))
        assert found.angle == pytest.approx(corner, rel=1e-6)
        assert found.depth == pytest.approx(slope * corner**2, rel=1e-6)
        assert found.sigma == pytest.approx(0.01 * corner**2, rel=1e-6)
        (text,) = sentences(pupil_findings(*hybrid(slope)))
        told = f"moves by {100 * corner**2:.0f} ± {found.sigma * 1e3:.0f} mm, which no lens does"
        assert f"{told} (11 mm at most, 35° off the axis)" in text
        assert "measure the squares" in text
    # Ten times what glass does, and two sigmas.
    assert pupil_findings(*hybrid(0.029)) == pupil_findings(*hybrid(-0.029)) == []
    assert len(pupil_findings(*hybrid(0.031))) == 1
    lens, covariance = hybrid(0.1)
    assert pupil_findings(lens, 26 * covariance) == []
    assert len(pupil_findings(lens, 24 * covariance)) == 1
    # A long lens is large: at small angles a centimeter is allowed.
    angle = math.atan(math.hypot(149.5, 149.5) / 500)
    for depth, count in ((0.0099, 0), (0.0101, 1)):
        lens, covariance = hybrid(depth / angle**2, 500.0)
        assert len(pupil_findings(lens, 1e-4 * covariance)) == count
