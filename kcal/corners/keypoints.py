"""Keypoints of an image with descriptors, and the rough relative pose of two cameras from them, by OpenCV."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kcal.corners.images import Gray, to_8bit

# Contrast of a keypoint on a scale on which OpenCV's default is 0.04: least-squares matching tells what is too faint.
_CONTRAST = 0.015
_SEED = 1


class Keypoints(NamedTuple):
    """Keypoints of an image, N of them, strongest first.

    Attributes:
        pixels: (N, 2) float64.
        descriptors: (N, 128) float32 of unit length: square roots of SIFT's (R. Arandjelović and A. Zisserman 2012).
    """

    pixels: Tensor
    descriptors: Tensor

    def at(self, which: Tensor) -> Keypoints:
        """Those at some places."""
        return Keypoints(self.pixels[which], self.descriptors[which])


def keypoints(image: Gray, most: int) -> Keypoints:
    """The strongest keypoints of an image (D. Lowe 2004), one at each place.

    Args:
        image: (H, W) gray levels.
        most: number at most.
    """
    found, descriptors = cv2.SIFT_create(contrastThreshold=_CONTRAST).detectAndCompute(to_8bit(image), None)  # type: ignore[attr-defined]
    if descriptors is None:
        return Keypoints(torch.zeros(0, 2, dtype=torch.float64), torch.zeros(0, 128))
    pixels = np.array([point.pt for point in found], np.float64)
    order = np.argsort([-point.response for point in found], kind="stable")
    # One place may have several orientations.
    _, first = np.unique(pixels[order].round(1), axis=0, return_index=True)
    kept = order[np.sort(first)][:most]
    root = np.sqrt(descriptors[kept] / np.maximum(descriptors[kept].sum(1, keepdims=True), 1e-9))
    return Keypoints(torch.from_numpy(pixels[kept]), torch.from_numpy(root))


def pose_between(first: Tensor, second: Tensor, tolerance: float) -> tuple[Tensor, Tensor, Tensor]:
    """Rotation (3, 3) and unit translation (3,) second_from_first of most of N pairs of rays, and which (N,) these are.

    Args:
        first: (N, 3) rays of one camera, N at least 5.
        second: (N, 3) of the other.
        tolerance: radians that a ray may be off its epipolar plane.
    """
    plane = [np.ascontiguousarray((rays[:, :2] / rays[:, 2:]).numpy()) for rays in (first, second)]
    cv2.setRNGSeed(_SEED)
    matrix, inside = cv2.findEssentialMat(plane[0], plane[1], np.eye(3), cv2.USAC_MAGSAC, 0.9999, tolerance, 5000)
    nothing = torch.zeros(len(first), dtype=torch.bool)
    if matrix is None or matrix.shape != (3, 3):
        return torch.eye(3, dtype=torch.float64), torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64), nothing
    mask: npt.NDArray[np.uint8] = (np.asarray(inside) > 0).astype(np.uint8)
    _, rotation, shift, ahead = cv2.recoverPose(matrix, plane[0], plane[1], np.eye(3), mask=mask)
    return tuple(torch.from_numpy(np.asarray(part)) for part in (rotation, shift[:, 0], ahead[:, 0] > 0))  # type: ignore[return-value]
