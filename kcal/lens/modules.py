"""`Unproject`: `Camera.unproject` as the `forward` of a module, for pipelines, `torch.export` and ONNX."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor, nn

from kcal.lens.camera import Camera


class LearnedStart(Protocol):
    """A module that guesses the inverse of a lens, such as `kcal.nets.InverseNet`."""

    def guess(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return roughly undistorted coordinates for distorted ones (..., N)."""
        ...


class Unproject(nn.Module):
    """Map pixels to rays: `Camera.unproject` as a module.

    The module of the other direction is `Camera` itself. Compiled and exported graphs take a fixed number of Newton
    steps for every point. The few pixels next to a fold that have not converged by then are not valid there, although
    an eager call may find their rays.

    `kcal.io.onnx_file.save_onnx` writes the module as ONNX.

    Args:
        camera: the camera, kept as a submodule.
        start: a trained `InverseNet`; its guess is where Newton's method starts. It affects run time only.

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
        """Map pixels (..., N, 2) to rays (..., N, 3) of length one, and valid (..., N)."""
        return self.camera.unproject(pixels, start=None if self.start is None else self.start.guess)
