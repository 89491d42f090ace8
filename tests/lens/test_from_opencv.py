"""Cameras and rigs from what OpenCV's functions return: values, shapes, refusals, and what is doubted."""

import warnings
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from kcal import Camera, InputError, KcalWarning, Rig

K = np.array([[800.1, 0, 322.3], [0, 820.7, 238.2], [0, 0, 1]])  # none of which a float32 holds
D = np.array([-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.02, -0.01, 2e-3, 1e-3, -5e-4, 4e-4, 1e-4, 0.01, -0.02])
SIZE = (640, 480)
POINTS = np.array([[0.3, -0.2, 1.0], [-0.1, 0.2, 2.0], [0.05, 0.02, 0.7]])


@pytest.mark.parametrize("count", [0, 4, 5, 8, 12, 14])
@pytest.mark.parametrize("shape", ["flat", "row", "column", "list"])
def test_pixels_are_those_of_cv2(count: int, shape: str) -> None:
    lens = D[:count]
    given: Any = {"flat": lens, "row": lens[None], "column": lens[:, None], "list": lens.tolist()}[shape]
    camera = Camera.from_opencv(K, given if count else None, SIZE)
    expected = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), K, lens if count else None)[0][:, 0]
    np.testing.assert_allclose(camera.project(POINTS)[0], expected, atol=1e-9)
    back, again = camera.to_opencv()
    assert (back == K).all()
    assert (again == (lens if count else np.zeros(4))).all()


def test_a_fisheye_with_skew() -> None:
    skewed = K + np.array([[0, 1.5, 0], [0, 0, 0], [0, 0, 0]])
    camera = Camera.from_opencv(skewed, D[:4], SIZE, fisheye=True)
    expected = cv2.fisheye.projectPoints(
        POINTS[:, None], np.zeros(3), np.zeros(3), skewed, D[:4], alpha=skewed[0, 1] / skewed[0, 0]
    )[0][:, 0]
    np.testing.assert_allclose(camera.project(POINTS)[0], expected, atol=1e-9)
    back, lens = camera.to_opencv()
    assert (back == skewed).all()
    assert (lens == D[:4]).all()


def test_a_rig_of_stereo_calibrate() -> None:
    rotation, shift = cv2.Rodrigues(np.array([0.01, -0.02, 0.03]))[0], np.array([[-0.12], [0.001], [0.002]])
    camera = Camera.from_opencv(K, D[:5], SIZE)
    rig = Rig.pair(camera, camera, rotation, shift)
    expected = cv2.projectPoints(POINTS, cv2.Rodrigues(rotation)[0], shift, K, D[:5])[0][:, 0]
    np.testing.assert_allclose(rig(POINTS)[0][..., 1, :], expected, atol=1e-9)
    assert rig.right_from_left_translation.shape == (3,)


@pytest.mark.parametrize(
    ("matrix", "lens", "size", "message"),
    [
        (K.T, None, SIZE, "no camera matrix.*give its transpose"),
        (K[:2], None, SIZE, r"\(3, 3\) is needed, got \(2, 3\)"),
        (K.ravel(), None, SIZE, r"\(3, 3\) is needed, got \(9,\)"),
        (K + np.array([[0, 2, 0]] + [[0] * 3] * 2), None, SIZE, "skew of 2 px, which cv2.projectPoints ignores"),
        (K, D[:6], SIZE, r"4 or 5 or 8 or 12 or 14 coefficients are needed, got shape \(6,\)"),
        (K, np.zeros((2, 2)), SIZE, r"got shape \(2, 2\)"),
        (K, np.zeros(20), SIZE, r"Camera.build\(..., model='ext20'\)"),
        (K * np.nan, None, SIZE, "no camera matrix"),
        (np.diag([-1.0, 1, 1]), None, SIZE, "focal lengths must be positive"),
        (K, None, (480, 640, 3), r"image.shape\[1::-1\]"),
        (K, None, (640.5, 480), "whole"),
        (K, None, None, r"\(width, height\)"),
        ("K", None, SIZE, "numbers is needed, got str"),
        (K, np.array([None] * 5), SIZE, "D: .* of object"),
    ],
)  # fmt: skip
def test_what_is_refused(matrix: Any, lens: Any, size: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Camera.from_opencv(matrix, lens, size)


def test_what_opencv_does_not_have() -> None:
    with pytest.raises(InputError, match="refit_camera"):
        Camera.build(focal=(8, 8), center=(4, 4), size=(9, 9), coefficients=[0] * 14 + [1], model="ext20").to_opencv()
    with pytest.raises(InputError, match="with skew"):
        Camera.build(focal=(8, 8), center=(4, 4), size=(9, 9), skew=1.0).to_opencv()
    with pytest.raises(InputError, match="not a batch"):
        Camera(torch.tensor([[8.0, 8, 4, 4, 0]] * 2), size=(9, 9), model="pinhole").to_opencv()
    # Coefficients that are zero are none.
    assert Camera.build(focal=(8, 8), center=(4, 4), size=(9, 9), model="ext20").to_opencv()[1].shape == (14,)
    with pytest.raises(InputError, match="4 coefficients are needed"):
        Camera.from_opencv(K, D[:5], SIZE, fisheye=True)


@pytest.mark.parametrize(
    ("matrix", "size", "message"),
    [
        (K, (480, 640), r"size is \(width, height\)"),
        (K, (1280, 960), "far from the middle .* numbers of another size"),
        (K, (320, 240), "outside an image .* numbers of another size"),
        (np.array([[1.2, 0, 0.5], [0, 1.2, 0.5], [0, 0, 1]]), SIZE, "must be in pixels"),
    ],
)
def test_what_is_doubted(matrix: Any, size: tuple[int, int], message: str) -> None:
    with pytest.warns(KcalWarning, match=message) as caught:
        Camera.from_opencv(matrix, None, size)
    assert caught[0].filename == __file__


def test_what_is_not_doubted() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Camera.from_opencv(K, None, SIZE)
        # A principal point that is 7 % off, and a square image.
        Camera.from_opencv(K + np.array([[0, 0, 40], [0, 0, 30], [0, 0, 0]]), None, SIZE)
        Camera.from_opencv(np.array([[500.0, 0, 300], [0, 500, 300], [0, 0, 1]]), None, (640, 640))
        # A circular fisheye of 220° in a wide frame.
        Camera.from_opencv(
            np.array([[281.0, 0, 960], [0, 281, 540], [0, 0, 1]]), np.zeros(4), (1920, 1080), fisheye=True
        )


def make_rig(*shift: float, turn: tuple[float, float, float] = (0, 0, 0)) -> Rig:
    camera = Camera.from_opencv(K, None, SIZE)
    return Rig.pair(camera, camera, cv2.Rodrigues(np.array(turn, dtype=float))[0], np.array(shift)[:, None])


@pytest.mark.parametrize(
    ("shift", "message"),
    [
        ((-10_000.0, 0, 0), "baseline is 10.0 km; the translation must be in meters"),
        ((-1e-4, 0, 0), "baseline is 0.100 mm; the translation must be in meters"),
        ((10.0, 0.5, 1.0), "the right camera stands 10.0 m to the left of the left one"),
    ],
)
def test_rigs_that_are_doubted(shift: tuple[float, ...], message: str) -> None:
    with pytest.warns(KcalWarning, match=message) as caught:
        rig = make_rig(*shift)
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # What kcal makes of a rig is not doubted anew.
        _ = rig.float().state_dict()


@pytest.mark.parametrize(
    ("shift", "turn"),
    [
        ((-0.06, 0, 0), (0, 0, 0)),
        ((-400.0, 0, 0), (0, 0, 0)),
        ((0.0, -0.3, 0), (0, 0, 0)),  # one above the other
        ((0.0, 0.3, 0), (0, 0, 0)),
        ((0.3, -0.3, 0.0), (0, 0, 0)),  # diagonal
        ((0.0, 0, 0), (0, 0, 0)),
        ((-5.0, 0, 0), (0, 3.0, 0)),  # back to back
    ],
)
def test_rigs_that_are_not_doubted(shift: tuple[float, ...], turn: tuple[float, float, float]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_rig(*shift, turn=turn)
