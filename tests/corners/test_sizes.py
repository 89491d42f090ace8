"""Images of one camera that were resized alike: their corners, covariances and what is said of them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from kcal.corners import detect as module
from kcal.corners.board import Board
from kcal.corners.detect import detect
from kcal.corners.observations import View, common_size, rescaled, resized_alike
from kcal.errors import InputError

BOARD = Board(columns=6, rows=5, square=0.02)


def checkerboard(side: int, left: int, top: int, size: tuple[int, int]) -> np.ndarray:
    """An image with squares of `side` px whose first one begins at (left, top); edges lie between pixels."""
    y, x = np.mgrid[: size[1], : size[0]]
    column, row = (x - left) // side, (y - top) // side
    on = (x >= left) & (y >= top) & (column <= BOARD.columns) & (row <= BOARD.rows)
    return np.where(on & ((column + row) % 2 == 0), 40, 220).astype(np.uint8)


@pytest.fixture
def folder(tmp_path):
    """Two whole images and one a third as large, in each direction."""
    for name, left in (("a", 90), ("b", 120)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), checkerboard(60, left, 90, (720, 540)))
    whole = checkerboard(60, 150, 120, (720, 540))
    cv2.imwrite(str(tmp_path / "c.png"), cv2.resize(whole, (240, 180), interpolation=cv2.INTER_AREA))
    return tmp_path


def test_corners_of_a_smaller_image_are_those_of_the_whole_one(folder) -> None:
    notes: list[str] = []
    seen = detect([folder / f"{name}.png" for name in "abc"], BOARD, note=notes.append)
    assert seen.image_size == (720, 540)
    # Edges of squares, between pixels: corner (1, 1) of the squares from (150, 120).
    first = torch.tensor([150.0 + 60.0 - 0.5, 120.0 + 60.0 - 0.5], dtype=torch.float64)
    torch.testing.assert_close(seen.pixels()[2, 0], first, rtol=0, atol=0.05)
    torch.testing.assert_close(seen.pixels()[2] - seen.pixels()[0], torch.tensor([60.0, 30.0]).double().expand(30, 2),
                               rtol=0, atol=0.06)  # fmt: skip
    assert notes == [
        "images of several sizes: corners were scaled to 720x540 px of most images: c.png from 240x180 px by 3"
    ]
    alone = detect([folder / "c.png"], BOARD)
    small, large = alone.covariances(), seen.covariances()
    assert small is not None
    assert large is not None
    torch.testing.assert_close(large[2], 9.0 * small[0], rtol=1e-9, atol=0)


def test_it_is_never_silent(folder) -> None:
    with pytest.warns(UserWarning, match="scaled to 720x540"):
        detect([folder / f"{name}.png" for name in "abc"], BOARD)


def test_most_images_decide_and_then_the_largest() -> None:
    sizes = [(640, 360), (1920, 1080), None, (640, 360)]
    found = common_size("abcd", sizes)
    assert found.size == (640, 360)
    assert found.scales == {1: (1 / 3, 1 / 3)}
    assert found.notes[0].endswith("b from 1920x1080 px by 0.3333")
    assert common_size("ab", sizes[:2]).size == (1920, 1080)
    assert common_size("ad", [(640, 360), (640, 360)]) == ((640, 360), {}, {}, ())


@pytest.mark.parametrize(
    ("one", "other", "alike"),
    [
        ((1500, 1000), (640, 427), True),
        ((1500, 1000), (640, 426), True),
        ((1500, 1000), (640, 425), False),
        ((6016, 4016), (3008, 2008), True),
        ((640, 480), (640, 360), False),
        ((640, 480), (480, 640), False),
        ((640, 480), (639, 479), False),
        ((640, 480), (640, 479), False),
    ],
)
def test_which_sizes_are_alike(one, other, alike) -> None:
    assert resized_alike(one, other) is alike
    assert resized_alike(other, one) is alike


def test_sides_that_were_rounded_have_scales_of_their_own() -> None:
    found = common_size("aab", [(1500, 1000), (1500, 1000), (640, 427)])
    assert found.scales == {2: (1500 / 640, 1000 / 427)}
    view = rescaled(
        View(name="b", pixels=((-0.5, -0.5), (639.5, 426.5)), covariance=((1, 0.5, 2),) * 2), found.scales[2]
    )
    assert view.pixels == ((-0.5, -0.5), (1499.5, 999.5))
    assert view.covariance is not None
    assert view.covariance[0] is not None
    x, y = found.scales[2]
    assert view.covariance[0] == pytest.approx((x * x, 0.5 * x * y, 2.0 * y * y))


@pytest.mark.parametrize(
    ("sizes", "left_out"),
    [
        ([(640, 480), (640, 480), (640, 360)], "640x360 px, not the 640x480 px of most images: cropped or of another"),
        ([(640, 480), (640, 480), (480, 640)], "480x640 px, not the 640x480 px of most images: turned by 90 degrees"),
        ([(640, 480), (320, 240), (240, 320)], "240x320 px, not the 640x480 px of most images: turned by 90 degrees"),
        ([(1281, 721), (1280, 720), (1280, 724)], "1280x724 px, not the 1281x721 px"),
    ],
)
def test_what_is_left_out(sizes, left_out) -> None:
    found = common_size("abc", sizes)
    assert found.size == sizes[0]
    assert list(found.left_out) == [2]
    assert found.left_out[2].startswith(left_out)
    assert found.notes[-1].startswith("1 of 3 images were left out, because their size is not")


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        (
            [(640, 480), (640, 360)],
            r"1 of 640x480 px \(a\); 1 of 640x360 px \(b\); run kcal detect on those of each size",
        ),
        ([(640, 480), (480, 640), None], "turn back those that were turned by 90 degrees, or run"),
        ([(640, 480), (640, 480), (640, 360), (500, 360)], "none has more than half: 2 of 640x480"),
    ],
)
def test_no_size_of_most_is_refused_with_counts(sizes, message) -> None:
    with pytest.raises(InputError, match=message):
        common_size("abcd"[: len(sizes)], sizes)
    assert common_size("ab", [None, None]).size == (0, 0)


def test_sizes_are_read_before_anything_is_searched(folder, monkeypatch) -> None:
    """A pixel or two more is the same camera; an image of another size costs no search, and the rest is there."""
    whole = checkerboard(60, 150, 90, (721, 541))
    cv2.imwrite(str(folder / "d.png"), whole)
    cv2.imwrite(str(folder / "foreign.jpg"), whole[:400])
    searched, find, notes = [], module.detect_board, []
    monkeypatch.setattr(module, "detect_board", lambda image, *rest: searched.append(image.shape) or find(image, *rest))
    seen = detect([folder / name for name in ("foreign.jpg", "a.png", "b.png", "d.png")], BOARD, note=notes.append)
    assert searched == [(540, 720), (540, 720), (541, 721)]
    assert (seen.names, seen.image_size) == (("a.png", "b.png", "d.png"), (720, 540))
    assert [failure.name for failure in seen.failures] == ["foreign.jpg"]
    assert [text.split(";")[0] for text in notes] == [
        "images of 721x541 px were taken as they are among the 720x540 px of most images",
        "1 of 4 images were left out, because their size is not the 720x540 px of most images: foreign.jpg",
    ]
    first = torch.tensor([150.0 + 60.0 - 0.5, 90.0 + 60.0 - 0.5], dtype=torch.float64)
    torch.testing.assert_close(seen.pixels()[2, 0], first, rtol=0, atol=0.05)
    with pytest.raises(InputError, match="1 of 721x400 px"):
        detect([folder / name for name in ("foreign.jpg", "a.png")], BOARD)
    assert len(searched) == 3
