"""Files of observed corners: their covariances read as they were packed, and what contradicts itself refused."""

from math import nan

import pytest
import torch

from kcal.corners.board import Board
from kcal.corners.detect import Detection, view_of
from kcal.corners.observations import Observations, View
from kcal.errors import FileError, InputError

BOARD = Board(columns=2, rows=2, square=0.1)
PIXELS = ((1.0, 2.0), (8.0, 2.5), None, (8.5, 7.0))
SPREAD = ((0.01, 0.002, 0.04), (0.02, -0.01, 0.03), None, (0.5, 0.0, 0.1))


def observed(**changes):
    view = {"name": "a.png", "pixels": PIXELS, "covariance": SPREAD, **changes}
    return Observations(board=BOARD, image_size=(10, 9), views=(View(**view),))


def test_covariances_are_uu_uv_vv():
    found = observed().covariances()
    for n, spread in enumerate(SPREAD):
        if spread is None:
            assert bool(found[0, n].isnan().all())
        else:
            uu, uv, vv = spread
            assert found[0, n].tolist() == [[uu, uv], [uv, vv]]
    assert observed(covariance=None).covariances() is None


def test_a_detection_comes_back_from_its_file(tmp_path):
    root = torch.randn(4, 2, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    pixels = torch.tensor([[nan if x is None else x for x in pixel or (None,) * 2] for pixel in PIXELS]).double()
    spread = root @ root.mT + 0.1 * torch.eye(2).double()
    spread[2] = nan
    view = view_of(Detection(pixels, covariance=spread), "a")
    path = Observations(board=BOARD, image_size=(10, 9), views=(view,)).save(tmp_path / "a.json")
    found = Observations.load(path)
    seen = torch.tensor([0, 1, 3])
    assert bool(found.pixels()[0, 2].isnan().all())
    torch.testing.assert_close(found.pixels()[0, seen], pixels[seen], rtol=0, atol=0)
    torch.testing.assert_close(found.covariances()[0, seen], spread[seen], rtol=0, atol=0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"covariance": (*SPREAD[:3], None)}, "seen corners, and only these"),
        ({"covariance": (*SPREAD[:2], (1.0, 0.0, 1.0), SPREAD[3])}, "seen corners, and only these"),
        ({"covariance": SPREAD[:3]}, "has 3 covariances"),
        ({"covariance": ((0.01, 0.021, 0.04), *SPREAD[1:])}, "not positive definite"),
        ({"covariance": ((-0.01, 0.0, -0.04), *SPREAD[1:])}, "not positive definite"),
        ({"pixels": PIXELS[:3], "covariance": None}, "has 3 corners, the board 4"),
    ],
)
def test_what_contradicts_itself_is_refused(changes, message):
    with pytest.raises(InputError, match=message):
        observed(**changes)


@pytest.mark.parametrize("outside", [(-2.6, 2.0), (11.6, 2.0), (1.0, -2.6), (1.0, 10.6), (2.0, 14.0)])
def test_corners_outside_the_image_are_refused(outside, tmp_path):
    # Two pixels beyond the edges are noise.
    assert observed(pixels=((-2.5, -2.5), (11.5, 10.5), None, (11.5, -2.5))).image_size == (10, 9)
    message = rf"view 'a\.png': 1 corner\(s\) lie outside the image of 10x9 px, one at \({outside[0]:.1f}, "
    with pytest.raises(InputError, match=message):
        observed(pixels=(*PIXELS[:3], outside))
    path = observed().save(tmp_path / "a.json")
    path.write_text(path.read_text().replace("8.5", str(outside[0]), 1).replace("7.0", str(outside[1]), 1))
    with pytest.raises(FileError, match=message):
        Observations.load(path)


def test_subset_keeps_the_order_that_was_asked_for():
    one = observed()
    both = Observations(board=BOARD, image_size=(10, 9), views=(*one.views, View(name="b.png", pixels=PIXELS)))
    assert both.subset(["b.png", "a.png"]).names == ("b.png", "a.png")
    assert both.covariances() is None
    with pytest.raises(InputError, match=r"no view named 'c\.png'"):
        both.subset(["a.png", "c.png"])
    with pytest.raises(InputError, match=r"share the name 'a\.png'"):
        Observations(board=BOARD, image_size=(10, 9), views=(*one.views, *one.views))
    with pytest.raises(InputError, match="no view with a board"):
        both.subset([]).pixels()
