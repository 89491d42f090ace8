"""Shapes and pictures of the marking page."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy import stats
from scipy.special import ndtr

from kcal.corners.images import read_gray
from kcal.errors import FileError, InputError
from kcal.io.images import write_png
from kcal.mark.guide import TILE, Pyramid, open_pictures, top_level
from kcal.mark.session import places_text, read_places
from kcal.mark.shapes import SHAPES, ShapeFit, _both_positive, fit_shape, slopes, starts_at

# Blurred shapes against their definitions, and fits whose stated errors are the errors that they make.


AXIS = np.arange(-9.0, 10.0)

WHERE = np.stack([part.ravel() for part in np.meshgrid(AXIS, AXIS)], -1)

DRAW = np.random.default_rng(4)

WEDGE, CORNER, CROSS, BLOB, END = SHAPES

# The point, and what each model adds to it.
TRUE = {
    "wedge": (WEDGE, [0.3, -0.2, 0.4, 0.4 + math.pi / 2, 1.0]),
    "corner": (CORNER, [0.3, -0.2, 0.4, 2.2, 0.8]),
    "cross": (CROSS, [0.3, -0.2, 0.4, 2.0, 3.0, 0.9]),
    "blob": (BLOB, [0.3, -0.2, 0.5, 3.0, 2.0, 1.5]),
    "end": (END, [0.3, -0.2, 0.4, 4.0, 0.9]),
}


def test_a_blurred_wedge_is_the_normal_probability() -> None:
    h, k = DRAW.normal(size=(2, 40))
    for correlation in (-0.98, -0.5, 0.0, 0.3, 0.9):
        wanted = [
            stats.multivariate_normal.cdf(pair, cov=[[1, correlation], [correlation, 1]])
            for pair in zip(h, k, strict=True)
        ]
        np.testing.assert_allclose(_both_positive(h, k, correlation), wanted, atol=2e-4)
    assert _both_positive(np.zeros(1), np.zeros(1), 0.5)[0] == pytest.approx(1 / 3, abs=1e-6)


def test_patterns() -> None:
    """Along the middle of each shape, by hand: first a constant, then the shape."""
    x = np.stack([AXIS, np.zeros_like(AXIS)], -1)
    right = [0.0, 0.0]
    end = END.patterns(x, np.array([*right, 0.0, 4.0, 0.5]))
    np.testing.assert_allclose(end[:, 0], 1.0)
    np.testing.assert_allclose(end[:, 1], (2 * ndtr(4.0) - 1) * ndtr(AXIS / 0.5))
    cross = CROSS.patterns(x, np.array([*right, 0.0, math.pi / 2, 2.0, 0.5]))
    bar = ndtr((AXIS + 1) / 0.5) - ndtr((AXIS - 1) / 0.5)
    np.testing.assert_allclose(cross[:, 1], 1 - (1 - bar) * (1 - (2 * ndtr(2.0) - 1)))
    blob = BLOB.patterns(x, np.array([*right, 0.0, 2.0, 5.0, 1.5]))
    np.testing.assert_allclose(blob[:, 1], np.exp(-0.5 * np.maximum((AXIS / 2) ** 2, 1e-12) ** 1.5))
    np.testing.assert_allclose(BLOB.patterns(x[:, ::-1], np.array([*right, 0.0, 5.0, 2.0, 1.5])), blob)
    corner = CORNER.patterns(x, np.array([*right, 0.0, math.pi / 2, 0.5]))
    np.testing.assert_allclose(
        corner, np.stack([0 * AXIS + 1, ndtr(AXIS / 0.5), 0 * AXIS + 0.5, ndtr(AXIS / 0.5) / 2], -1)
    )
    np.testing.assert_allclose(WEDGE.patterns(x, np.array([*right, 0.0, math.pi / 2, 0.5])), corner[:, [0, 3]])
    # Lines that nearly coincide are one edge, and stay finite.
    assert np.isfinite(CORNER.patterns(WHERE, np.array([*right, 0.0, 1e-3, 0.5]))).all()


def test_starts() -> None:
    at = np.array([[1.0, 2.0], [3.0, 4.0]])
    for shape in SHAPES:
        starts = starts_at(shape, at)
        assert starts.shape == (2 * len(shape.starts), 2 + len(shape.low))
        assert np.array_equal(starts[: len(shape.starts), :2], np.tile(at[0], (len(shape.starts), 1)))
        assert (starts[:, 2:] >= shape.low).all()
        assert (starts[:, 2:] <= shape.high).all()
    np.testing.assert_allclose(CROSS.starts[:, 1] - CROSS.starts[:, 0], math.pi / 2)
    # Each pair of lines once.
    assert len(CORNER.starts) == 28
    assert (CORNER.starts[:, 0] < CORNER.starts[:, 1]).all()
    assert len(WEDGE.starts) == 24


def fitted(kind: str, noise: np.ndarray | float, window: float = 3.0) -> ShapeFit:
    shape, parameters = TRUE[kind]
    p = np.array(parameters)
    gray = shape.patterns(WHERE, p) @ np.array([60.0, *[90.0, -40.0, 30.0][: shape.patterns(WHERE, p).shape[1] - 1]])
    gray = gray + 0.5 * WHERE[:, 0] + noise
    weight = np.exp(-0.5 * np.square(WHERE - p[:2]).sum(-1) / window**2)
    start = p + np.array([0.3, -0.3, *[0.05] * (len(p) - 2)])
    found = fit_shape(shape, WHERE, gray, weight, start[None])
    assert found is not None
    return found


@pytest.mark.parametrize("kind", TRUE)
def test_exact_levels_give_the_point(kind: str) -> None:
    found = fitted(kind, 0.0)
    np.testing.assert_allclose(found.point, [0.3, -0.2], atol=2e-3)
    np.testing.assert_allclose(found.parameters[2:], TRUE[kind][1][2:], atol=0.05)
    assert found.explained > 0.999
    assert found.noise < 0.2
    assert found.shape == TRUE[kind][0].name


@pytest.mark.parametrize("kind", ["wedge", "blob", "end"])
def test_errors_are_as_large_as_stated(kind: str) -> None:
    """Of white noise of 2 levels."""
    fits = [fitted(kind, DRAW.normal(0, 2.0, len(WHERE))) for _ in range(40)]
    off = np.array([fit.point for fit in fits]) - [0.3, -0.2]
    share = [float(d @ np.linalg.solve(fit.covariance, d)) for d, fit in zip(off, fits, strict=True)]
    # Two degrees of freedom; of 40 draws the mean is within a quarter.
    assert 1.4 < float(np.mean(share)) < 2.6
    assert float(np.mean([fit.noise for fit in fits])) == pytest.approx(2.0, rel=0.1)


def test_the_criterion_prefers_the_fewer_parameters() -> None:
    """The Bayesian one: of the same residuals, each parameter more costs ln n."""
    shape, parameters = TRUE["wedge"]
    p = np.array(parameters)
    gray = shape.patterns(WHERE, p) @ np.array([60.0, 90.0]) + DRAW.normal(0, 2.0, len(WHERE))
    weight = np.ones(len(WHERE))
    own, richer = (fit_shape(s, WHERE, gray, weight, p[None]) for s in (WEDGE, CORNER))
    count = len(WHERE)
    for fit, unknowns in ((own, 5 + 2 + 2), (richer, 5 + 4 + 2)):
        rss = fit.noise**2 * (count - unknowns)
        assert fit.score == pytest.approx(count * math.log(rss / count) + unknowns * math.log(count))
        assert fit.explained == pytest.approx(1 - rss / np.square(gray - gray.mean()).sum())
    assert own.score < richer.score


def test_slopes() -> None:
    def residual(p: np.ndarray) -> np.ndarray:
        return np.array([p[0] ** 2, p[0] * p[1], 3.0])

    p = np.array([2.0, 5.0])
    np.testing.assert_allclose(slopes(residual, p, residual(p)), [[4, 0], [5, 2], [0, 0]], atol=1e-4)


def test_places_are_written_as_they_were_read(tmp_path: Path) -> None:
    path = tmp_path / "survey.csv"
    for text in ("name,lat,lon,height,sigma,sigma_up\npier,50.1,3.25,12.5,0.02,\nmast,50.2,3.5,1.0,0.1,0.3\n",
                 'name,east,north,up,sigma,sigma_up\n"a, b",1.0,-2.0,0.25,0.02,0.5\n'):  # fmt: skip
        path.write_text(text)
        found = read_places(path)
        assert places_text(found) == text
        assert next(iter(found.places.values())).sigma == 0.02
    path.write_text(f"name,east,north,up,sigma\n{'n' * 60},1,2,3,0.1\n")
    assert len(read_places(path).places) == 1
    path.write_text(f"name,east,north,up,sigma\n{'n' * 61},1,2,3,0.1\n")
    with pytest.raises(FileError, match="more than 60 characters"):
        read_places(path)


def noise(height: int, width: int, dtype: type = np.uint8) -> np.ndarray:
    return np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (height, width), dtype=dtype)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_tiles_are_the_image_and_its_means(dtype: type) -> None:
    image = noise(1300, 1100, dtype)
    pyramid = Pyramid(image)
    assert top_level(image.shape) == 2
    span = None if dtype is np.uint8 else (0.0, 65535.0)
    tile = pyramid.tile(0, 2, 1, span).astype(float)
    part = image[TILE : 2 * TILE, 2 * TILE :].astype(float) / (1 if span is None else 257)
    assert tile.shape == (512, 76)
    assert np.abs(tile - part).max() <= 0.5
    means = image[:1300, :1100].reshape(325, 4, 275, 4).mean((1, 3)) / (1 if span is None else 257)
    assert np.abs(pyramid.tile(2, 0, 0, span) - means).max() <= 1.01
    for bad in ((3, 0, 0), (0, 3, 0), (0, 0, -1)):
        with pytest.raises(InputError, match="no tile"):
            pyramid.tile(*bad)


def test_colors_are_shown_and_gray_levels_measured(tmp_path: Path) -> None:
    colors = np.random.default_rng(1).integers(0, 255, (64, 96, 3), dtype=np.uint8)
    write_png(tmp_path / "left.png", colors)
    write_png(tmp_path / "right.png", np.repeat(colors[..., :1], 3, axis=2))
    pictures = open_pictures(tmp_path / "left.png", tmp_path / "right.png")
    left, right = pictures.pyramid("left", 0), pictures.pyramid("right", 0)
    np.testing.assert_array_equal(left.tile(0, 0, 0), colors)
    np.testing.assert_array_equal(left.image, read_gray(tmp_path / "left.png"))
    # Colors that are none are sent as gray levels, in a third of the bytes.
    np.testing.assert_array_equal(right.tile(0, 0, 0), colors[..., 0])
    deep = Pyramid(left.image, lambda: colors.astype(np.uint16) * 257)
    np.testing.assert_array_equal(deep.tile(0, 0, 0, (0.0, 65535.0)), colors)
    means = colors.reshape(32, 2, 48, 2, 3).mean((1, 3))
    assert np.abs(deep.level(1) / 257 - means).max() < 0.51
    assert np.abs(left.level(1).astype(float) - means).max() <= 0.75


def test_folders_are_paired_by_name(tmp_path: Path) -> None:
    for side, numbers in (("left", (1, 2, 3)), ("right", (2, 3, 4))):
        (tmp_path / side).mkdir()
        for number in numbers:
            write_png(
                tmp_path / side / f"{side}{number:02d}.png",
                np.full((20, 30), number, np.uint8) + np.eye(20, 30, dtype=np.uint8),
            )
    pictures = open_pictures(tmp_path / "left", tmp_path / "right")
    assert pictures.names == ("left02", "left03")
    assert pictures.image("right", 1)[5, 0] == 3
    with pytest.raises(InputError, match="no frame 2"):
        pictures.image("left", 2)


def test_videos_are_paired_by_frame(tmp_path: Path) -> None:
    for side, count in (("left", 5), ("right", 4)):
        video = cv2.VideoWriter(str(tmp_path / f"{side}.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
        for number in range(count):
            # Blue, green, red.
            video.write(np.full((48, 64, 3), np.array([30, 0, 13]) + 40 * number + 10, np.uint8))
        video.release()
    pictures = open_pictures(tmp_path / "left.avi", tmp_path / "right.avi")
    assert len(pictures.names) == 4
    for number in (2, 0, 3, 1):
        assert abs(float(pictures.image("left", number).mean()) - (40 * number + 17)) < 3
        red, _, blue = pictures.pyramid("left", number).tile(0, 0, 0).mean((0, 1))
        assert abs(red - (40 * number + 23)) < 5
        assert abs(blue - (40 * number + 40)) < 5
    write_png(tmp_path / "one.png", noise(20, 30))
    with pytest.raises(InputError, match="two images, two folders or two videos"):
        open_pictures(tmp_path / "left.avi", tmp_path / "one.png")
