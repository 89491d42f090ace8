"""Conventions, and checks of arguments."""

import ast
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from kcal import Board, CalibrationOptions, Camera, InputError, Observations, View, calibrate_camera
from kcal.checks import Float64Module, as_covariance, as_points, as_size, require_finite
from kcal.file_kind import check_pixel_count
from kcal.files import is_stream, source_name
from kcal.lens import LensModel, rotation_from_vector

# docs/reference/conventions.md: conventions of more than one floor, and every test that the page names exists.


TESTS = Path(__file__).parent

PAGE = (TESTS.parent / "docs" / "reference" / "conventions.md").read_text(encoding="utf-8")

NAMED = sorted(set(re.findall(r"`([\w/]+\.py(?:::\w+)*)`", PAGE)))


def test_board_points() -> None:
    points = Board(columns=3, rows=2, square=0.5).points
    assert points.tolist() == [[x, y, 0.0] for y in (0.0, 0.5) for x in (0.0, 0.5, 1.0)]
    assert points.dtype == torch.float64


def test_rms_is_over_points() -> None:
    """Residuals that no parameter can take up: a known pattern of ±0.1 px, alike on both axes."""
    board = Board(columns=9, rows=8, square=0.05)
    camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.1, 0.02])
    tilts = torch.tensor([[0.5, 0, 0], [-0.5, 0.1, 0], [0, 0.5, 0.2], [0.1, -0.5, 0]], dtype=torch.float64)
    checker = torch.tensor([(-1.0) ** (i // 9 + i % 9) for i in range(72)], dtype=torch.float64)[:, None] * 0.1
    views = []
    for i, rotation in enumerate(rotation_from_vector(tilts)):
        points = board.points @ rotation.T + torch.tensor([-0.2, -0.17, 1.0], dtype=torch.float64)
        views.append(View(name=str(i), pixels=(camera.project(points)[0] + checker).tolist()))
    seen = Observations(board=board, image_size=(640, 480), views=tuple(views))
    # Single corners of a printed board could be off by the pattern.
    result = calibrate_camera(seen, CalibrationOptions(board="exact"))
    finite = result.residuals[torch.isfinite(result.residuals).all(-1)]
    assert result.rms == pytest.approx(float((finite**2).sum(-1).mean().sqrt()), rel=1e-12)
    # Were it over coordinates it would be 0.1. The fit takes up a little of the pattern, hence the room.
    assert result.rms == pytest.approx(0.1 * math.sqrt(2), rel=0.03)


def test_the_table_of_coefficients_is_the_order() -> None:
    rows = re.findall(r"^\| (\d+)(?:(?:, | to )(\d+))? \| ([\w, ]+) \| (.*) \|$", PAGE, re.MULTILINE)
    names: list[str] = []
    for first, last, listed, _ in rows:
        assert int(first) == len(names) + 1
        names += listed.split(", ")
        assert int(last or first) == len(names)
    assert tuple(names) == LensModel(numerator=7, denominator=7, tangential=True, prism=4, tilt=True).names


@pytest.mark.parametrize("named", NAMED)
def test_named_tests_exist(named: str) -> None:
    path, *parts = named.split("::")
    scope = ast.parse((TESTS / path).read_text(encoding="utf-8")).body
    for part in parts:
        found = [node for node in scope if getattr(node, "name", None) == part]
        assert found, f"{part} is not in {path}"
        scope = getattr(found[0], "body", [])


def test_the_page_names_tests() -> None:
    assert len(NAMED) > 20


# What users pass is refused where it is no points, no covariance or not finite, and otherwise kept to the last bit.


F64 = torch.float64


def test_points_are_float64_of_the_right_shape() -> None:
    assert as_points("x", torch.ones(3, 2, dtype=torch.float32), 2).dtype == F64
    assert as_points("x", torch.ones(2, dtype=F64), 2).shape == (2,)
    for value, message in (
        (torch.ones(3, 2, dtype=torch.int64), r"floating point is needed, got torch.int64"),
        (torch.ones(3, 2, dtype=torch.float16), r"torch.float16 has steps of 0.5 near 1000"),
        (torch.ones(3, 2, dtype=torch.bfloat16), r"torch.bfloat16 has steps of 4 near 1000"),
        (torch.tensor(1.0), r"shape \(..., 2\) is needed, got \(\)"),
        (torch.ones(2, 3), r"shape \(..., 2\) is needed, got \(2, 3\)"),
    ):
        with pytest.raises(InputError, match=message):
            as_points("x", value, 2)


class Table:
    """Columns as pandas has them: an array on demand."""

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return self.values


ROWS = np.array([[1.5, 2.0], [3.0, 4.25]])


@pytest.mark.parametrize(
    "value",
    [
        ROWS, ROWS.tolist(), tuple(map(tuple, ROWS)), list(ROWS), Table(ROWS), ROWS.astype(np.float32),
        ROWS.astype(">f8"), ROWS.astype(np.longdouble), np.asfortranarray(ROWS), ROWS[::-1][::-1],
        np.broadcast_to(ROWS, (2, 2)), list(torch.from_numpy(ROWS)), np.ma.masked_array(ROWS.copy()).data,
    ],
)  # fmt: skip
def test_arrays_lists_and_tables_are_converted(value: Any) -> None:
    found = as_points("x", value, 2)
    assert torch.equal(found, torch.from_numpy(ROWS))
    # Nothing is shared with the caller, who may write into the array afterwards.
    found += 1.0
    assert ROWS[0, 0] == 1.5


def test_whole_numbers_of_a_list_are_exact() -> None:
    assert torch.equal(as_points("x", [[960, 540]], 2), torch.tensor([[960.0, 540.0]]).double())
    assert as_points("x", [], 0).shape == (0,)


class Quantity(Table):
    unit = "mm"


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (ROWS.astype(np.int32), r"x: floating point is needed, got torch.int64; convert with .astype\(float\)"),
        (Table(ROWS.astype(np.uint64)), r"got torch.int64; convert with .astype\(float\)"),
        (ROWS.astype(np.float16), "torch.float16 has steps of 0.5"),
        (ROWS.astype(object), r"got ndarray of object; convert with .astype\(float\)"),
        (ROWS.astype(str), "got ndarray of <U"),
        (ROWS > 2, "got ndarray of bool"),
        (ROWS + 1j, "got ndarray of complex128"),
        ([[1.0, None]], "got list of object"),
        ([[1.0, 2.0], [3.0]], "one array is needed, got a list"),
        ([torch.ones(2, requires_grad=True)], "use torch.stack"),
        (None, "x: a tensor or array of numbers is needed, got NoneType$"),
        ("12", "got str$"),
        (torch.nn.Linear(2, 2), "got Linear$"),
        (Quantity(ROWS), "these are in mm; convert to meters or pixels"),
        (np.ma.masked_array(ROWS, ROWS > 2), "would lose its mask"),
        (np.zeros((2, 5)), r"shape \(..., 2\) is needed, got \(2, 5\); transpose it"),
        (np.zeros((5, 3)), r"shape \(..., 2\) is needed, got \(5, 3\)$"),
    ],
)
def test_what_is_no_array_of_points(value: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        as_points("x", value, 2)


def test_devices() -> None:
    there = torch.empty(0, device="meta")
    assert as_points("x", ROWS, 2, like=there).device == there.device
    with pytest.raises(InputError, match=r"x: on cpu, the parameters on meta; move one of them with .to\(\)"):
        as_points("x", torch.from_numpy(ROWS), 2, like=there)


def test_sizes() -> None:
    for size in ((1920, 1080), [1920.0, 1080], np.array([1920, 1080]), torch.tensor([1920, 1080])):
        assert as_size(size) == (1920, 1080)
    for size in ((1920,), (1080, 1920, 3), (1920.5, 1080), (0, 5), (float("nan"), 5), (float("inf"), 5), None, 5, "ab"):
        with pytest.raises(InputError, match=r"\(width, height\) in pixels is needed"):
            as_size(size)


def test_the_first_value_that_is_not_finite_is_named() -> None:
    require_finite("x", torch.full((3,), 1e308, dtype=F64))  # whose sum is infinite
    require_finite("x", torch.zeros(0))
    value = torch.zeros(2, 3)
    value[1, 0], value[1, 2] = torch.nan, -torch.inf
    with pytest.raises(InputError, match=r"x: 2 of 6 values are not finite, first at \(1, 0\)"):
        require_finite("x", value)


def test_covariances() -> None:
    assert torch.equal(as_covariance("x", None, 2), torch.zeros(2, 2, dtype=F64))
    # Of units that differ by a million, with rounding that is not symmetric; and of rank one, and zero.
    found = as_covariance("x", torch.tensor([[1e12, 3e5], [3e5 * (1 + 1e-10), 1.0]], dtype=F64), 2)
    assert torch.equal(found, found.T)
    assert float(found[0, 1]) == pytest.approx(3e5 * (1 + 5e-11), rel=1e-13)
    for good in (torch.ones(2, 2), torch.zeros(2, 2), torch.tensor([[0.0, 0.0], [0.0, 4.0]])):
        assert torch.equal(as_covariance("x", good, 2), good.double())


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (torch.eye(3), r"shape \(2, 2\) is needed, got \(3, 3\)"),
        ([1.0, 0.0], r"is needed, got \(2,\)"),
        (torch.tensor([[1.0, torch.nan], [torch.nan, 1.0]]), "2 of 4 values are not finite"),
        (torch.tensor([[1.0, 1.01], [1.01, 1.0]]), "no negative eigenvalue"),
        (torch.tensor([[-1e-3, 0.0], [0.0, 1.0]]), "no negative eigenvalue"),
        (torch.tensor([[1e12, 3e5], [3.01e5, 1.0]]), "must be symmetric"),
        (torch.tensor([[1e-12, 1e-7], [1.01e-7, 1.0]], dtype=F64), "must be symmetric"),
    ],
)
def test_what_is_no_covariance(matrix: Tensor, message: str) -> None:
    with pytest.raises(InputError, match=message):
        as_covariance("x", matrix, 2)


def test_modules_keep_their_precision() -> None:
    module = Float64Module()
    module.register_buffer("fine", torch.ones(1, dtype=F64) / 3)
    module.register_buffer("coarse", torch.ones(1))
    for moved in (module.float(), module.half(), module.to(torch.float16)):
        assert float(moved.fine) == 1 / 3  # type: ignore[arg-type]
    assert module.coarse.dtype == torch.float16


def test_pixel_counts() -> None:
    assert check_pixel_count((500_000_000, 1)) == (500_000_000, 1)
    with pytest.raises(ValueError, match="500000001x1 pixels; an image may have at most 500 megapixels"):
        check_pixel_count((500_000_001, 1))
    with pytest.raises(ValueError, match=r"^more than 1e12 pixels"):
        check_pixel_count((10**12, 1))


def test_sources() -> None:
    for text in ("rtsp://a/b", "RTSPS://a", "rtmp://a", "https://a", "udp://a", "tcp://a", "srt://a", "camera:12"):
        assert is_stream(text)
    for text in ("camera:", "camera:0.mp4", "a/rtsp://b", "file://a", "shots.mp4", ""):
        assert not is_stream(text)
    names = {
        "rtsp://user:secret@10.0.0.7:554/main?token=1": "10.0.0.7", "udp://": "stream", "camera:3": "camera:3",
        "night/shots.mp4": "shots.mp4", "x://b/c": "c",
    }  # fmt: skip
    for source, name in names.items():
        assert source_name(source) == name
