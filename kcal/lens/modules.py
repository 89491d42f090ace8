"""`Unproject`: a camera's inverse as a module of its own, for pipelines, `torch.export` and ONNX.

`Camera` itself is the module of the other direction: its `forward` is `project`.
"""

from __future__ import annotations

from typing import Protocol

from torch import Tensor, nn

from kcal.lens.camera import Camera


class LearnedStart(Protocol):
    """A learned start for the inverse, such as `kcal.nets.inverse.InverseNet`; an `nn.Module`."""

    def guess(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Roughly the undistorted coordinates of distorted ones (..., N)."""
        ...


class Unproject(nn.Module):
    """Pixels to rays, as `Camera.unproject`.

    Compiled and exported graphs take a fixed number of Newton steps for every point: what has not arrived by
    then, beside a fold, is flagged as not valid. An eager call goes on until it knows.

    `kcal.io.onnx_file.save_onnx` writes it, and every other module of points, as ONNX.

    Args:
        camera: the camera, kept as a submodule.
        start: a trained inverse net whose guess Newton's method starts from; it never changes the answer.

    Example:
        >>> import torch
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.1])
        >>> rays, valid = Unproject(camera)(torch.tensor([[320.0, 240.0]]))
        >>> rays.tolist(), valid.tolist()
        ([[0.0, 0.0, 1.0]], [True])
    """

    def __init__(self, camera: Camera, start: LearnedStart | None = None) -> None:
        super().__init__()
        self.camera = camera
        self.start = start

    def forward(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (..., N, 2) -> rays (..., N, 3) of length one, valid (..., N)."""
        return self.camera.unproject(pixels, start=None if self.start is None else self.start.guess)
