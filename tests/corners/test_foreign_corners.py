"""Corners of other programs: their order, pixel origins and weights."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from kcal.corners.board import Board
from kcal.corners.foreign_corners import import_corners
from kcal.errors import FileError, InputError

BOARD = Board(columns=3, rows=2, square=0.025)
SIZE = (640, 480)


def test_vnl_levels_are_weights(tmp_path: Path) -> None:
    lines = ["## made by mrgingham", "# filename x y level", "none.png - - -"]
    lines += [f"a.png {10 * i}.5 {i} {level}" for i, level in enumerate((0, 1, 2, 0, 0))] + ["a.png - - -"]
    path = tmp_path / "corners.vnl"
    path.write_text("\n".join(lines))
    seen = import_corners(path, BOARD, SIZE)
    assert seen.names == ("a.png",)
    assert seen.views[0].pixels[1] == (10.5, 1.0)
    assert seen.views[0].pixels[5] is None
    assert seen.views[0].covariance is not None
    assert [spread and spread[0] for spread in seen.views[0].covariance] == [1.0, 4.0, 16.0, 1.0, 1.0, None]


def test_vnl_weights_and_outliers(tmp_path: Path) -> None:
    path = tmp_path / "corners.vnl"
    rows = [f"a.png {i} {i} {weight}" for i, weight in enumerate((1, 0.5, 0, -1, 1, 1))]
    path.write_text("\n".join(["# filename x y weight", *rows]))
    view = import_corners(path, BOARD, SIZE).views[0]
    assert [pixel is None for pixel in view.pixels] == [False, False, True, True, False, False]
    assert view.covariance is not None
    assert view.covariance[1] == (4.0, 0.0, 4.0)


@pytest.mark.parametrize("by", ["corner", "column,row"])
def test_csv_in_any_order(tmp_path: Path, by: str) -> None:
    path = tmp_path / "corners.csv"
    places = {"corner": ("4", "0"), "column,row": ("1,1", "0,0")}[by]
    path.write_text(f"image,{by},u,v,weight\na,{places[0]},7,8,1\na,{places[1]},1,2,0.25\n")
    view = import_corners(path, BOARD, SIZE).views[0]
    assert (view.pixels[4], view.pixels[0], view.pixels[1]) == ((7.0, 8.0), (1.0, 2.0), None)
    assert view.covariance is not None
    assert view.covariance[0] == (16.0, 0.0, 16.0)


def test_opencv(tmp_path: Path) -> None:
    path = tmp_path / "out.yml"
    points = np.arange(24, dtype=np.float32).reshape(2, 6, 2)
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in (("image_width", 640), ("image_height", 480), ("image_points", points)):
        file.write(name, value)
    file.release()
    seen = import_corners(path, BOARD)
    assert (seen.image_size, seen.names) == (SIZE, ("001", "002"))
    assert seen.views[1].pixels[5] == (22.0, 23.0)
    assert seen.views[1].covariance is None


@pytest.mark.parametrize("world", [True, False])
def test_matlab_goes_down_the_columns_from_pixel_one(tmp_path: Path, world: bool) -> None:
    path = tmp_path / "corners.mat"
    columns, rows = np.repeat(np.arange(3), 2), np.tile(np.arange(2), 3)
    points = np.stack([100.0 * columns + 1, 10.0 * rows + 1], 1)[..., None].repeat(2, 2)
    points[3, :, 1] = np.nan
    content = {"imagePoints": points, "imageSize": [480, 640]}
    savemat(path, content | ({"worldPoints": 25.0 * np.stack([columns, rows], 1)} if world else {}))
    seen = import_corners(path, BOARD)
    assert seen.image_size == SIZE
    assert seen.views[0].pixels == tuple((100.0 * (i % 3), 10.0 * (i // 3)) for i in range(6))
    assert seen.views[1].pixels[4] is None


@pytest.mark.parametrize(
    ("name", "text", "what"),
    [
        ("a.vnl", "# filename x y level\na 1 2 0\n", "a has 1 corners, the board 6"),
        ("a.vnl", "# file x y\na 1 2 0\n", "the header is"),
        ("a.vnl", "# filename x y level\na 1 2\n", "line 2"),
        ("a.csv", "image,u,v,size\na,1,2,3\n", "the header is"),
        ("a.csv", "image,corner,u,v\na,6,1,2\n", "line 2: corner 6"),
        ("a.csv", "image,corner,u,v\na,1,1,2\na,1,1,2\n", "occurs twice"),
        ("a.csv", "image,corner,u,v\na,1,inf,2\n", "no finite numbers"),
        ("a.csv", "image,corner,u,v\na,1,,2\n", "no view with corners"),
        ("a.mat", "nothing", r"not a \.mat file"),
    ],
)
def test_bad_files(tmp_path: Path, name: str, text: str, what: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(FileError, match=what):
        import_corners(tmp_path / name, BOARD, SIZE)


def test_what_is_not_in_the_file(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("image,corner,u,v\na,1,1,2\n")
    with pytest.raises(InputError, match="--size"):
        import_corners(tmp_path / "a.csv", BOARD)
    with pytest.raises(InputError, match=r"\.vnl"):
        import_corners(tmp_path / "a.doc", BOARD)
