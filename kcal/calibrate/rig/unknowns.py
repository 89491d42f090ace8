"""What a rig's adjustment may change of its cameras and of its board: linear functions of a few unknowns."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.bundle.board_problem import warp_shape
from kcal.calibrate.bundle.views import free_parameters
from kcal.errors import InputError
from kcal.lens.camera import Camera


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class SharedUnknowns:
    """Unknowns y (K,): parameters of camera c change with them by cameras[c] y, the board by shapes · (board y).

    Args:
        cameras: (5 + P, K) of each.
        shapes: (B, 3, N) displacements of the board's corners, meters.
        board: (B, K).
        begin: (K,) what they are for cameras and board as given.
        known: (K,) whether an unknown is a standard normal beforehand; nothing is known of the others.
        labels: (K,) names of those that have one.
    """

    cameras: tuple[Tensor, ...]
    shapes: Tensor
    board: Tensor
    begin: Tensor
    known: Tensor
    labels: tuple[str, ...]

    def __len__(self) -> int:
        """How many unknowns there are."""
        return len(self.known)

    def and_warp(self, board_points: Tensor) -> SharedUnknowns:
        """These, and two parabolas by which the board bends."""
        shape = warp_shape(board_points)
        shapes = torch.zeros(2, 3, len(board_points), dtype=torch.float64)
        shapes[:, 2] = shape
        cameras = [torch.cat([part, part.new_zeros(len(part), 2)], 1) for part in self.cameras]
        board = torch.cat([torch.zeros(2, len(self), dtype=torch.float64), torch.eye(2, dtype=torch.float64)], 1)
        return SharedUnknowns(
            cameras=tuple(cameras),
            shapes=shapes,
            board=board,
            begin=torch.cat([self.begin, self.begin.new_zeros(2)]),
            known=torch.cat([self.known, torch.zeros(2, dtype=torch.bool)]),
            labels=(*self.labels, "the board's warp along its rows", "the board's warp along its columns"),
        )


def held(cameras: Sequence[Camera]) -> SharedUnknowns:
    """Nothing: cameras and board are as they are."""
    return SharedUnknowns(
        cameras=tuple(torch.zeros(camera.params.shape[-1], 0, dtype=torch.float64) for camera in cameras),
        shapes=torch.zeros(0, 3, 0, dtype=torch.float64),
        board=torch.zeros(0, 0, dtype=torch.float64),
        begin=torch.zeros(0, dtype=torch.float64),
        known=torch.zeros(0, dtype=torch.bool),
        labels=(),
    )


def free(cameras: Sequence[Camera], names: Sequence[str]) -> SharedUnknowns:
    """All parameters of all cameras; nothing is known of them.

    Raises:
        InputError: hybrid cameras, whose parameters have meaning only with what their calibrations know.
    """
    if any(camera.model.hybrid for camera in cameras):
        raise InputError(
            "hybrid cameras cannot be refined without what their own calibrations know: hold them, take what their "
            "calibrations know as prior, or calibrate parametric cameras"
        )
    chosen = [free_parameters(camera.model) for camera in cameras]
    count = sum(len(own) for own in chosen)
    maps, labels, end = [], [], 0
    for camera, own, name in zip(cameras, chosen, names, strict=True):
        part = torch.zeros(len(camera.names), count, dtype=torch.float64)
        for column, index in enumerate(own, start=end):
            part[index, column] = 1.0
            labels.append(f"{camera.names[index]} of {name}")
        end += len(own)
        maps.append(part)
    return dataclasses.replace(
        held(cameras),
        cameras=tuple(maps),
        board=torch.zeros(0, count, dtype=torch.float64),
        begin=torch.zeros(count, dtype=torch.float64),
        known=torch.zeros(count, dtype=torch.bool),
        labels=tuple(labels),
    )
