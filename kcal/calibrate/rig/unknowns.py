"""What a rig's adjustment may change of its cameras, its board and the air: linear functions of a few unknowns."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.problem.state import warp_modes
from kcal.calibrate.problem.views import free_parameters
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.mounting import check_refraction


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
        refraction: coefficient of refraction of light for the unknowns as they begin.
        by_refraction: (K,) of it by each unknown; None: it is held.
        by_effects: (E, K) of what shifts stars (`StarEffect`), then landmarks (`LandmarkEffect`), and then features
            (`FeatureEffect`) together, by each unknown; None: there is nothing.
    """

    cameras: tuple[Tensor, ...]
    shapes: Tensor
    board: Tensor
    begin: Tensor
    known: Tensor
    labels: tuple[str, ...]
    refraction: float = 0.0
    by_refraction: Tensor | None = None
    by_effects: Tensor | None = None

    @property
    def refine_lenses(self) -> bool:
        """Whether lenses or board may change within what is known of them."""
        return bool(torch.cat([*self.cameras, self.board])[:, self.known].any())

    def __len__(self) -> int:
        """How many unknowns there are."""
        return len(self.known)

    def and_warp(self, board_points: Tensor) -> SharedUnknowns:
        """These, and two parabolas by which the board bends."""
        shapes = warp_modes(board_points)
        board = torch.cat([torch.zeros(2, len(self), dtype=torch.float64), torch.eye(2, dtype=torch.float64)], 1)
        more = self._and("the board's warp along its rows", "the board's warp along its columns", known=False)
        return dataclasses.replace(more, shapes=shapes, board=board)

    def and_refraction(self, refraction: float, sigma: float) -> SharedUnknowns:
        """These, and the coefficient of refraction with its standard deviation; with none, it is held."""
        check_refraction(refraction, sigma)
        if not sigma:
            return dataclasses.replace(self, refraction=refraction)
        more = self._and("the coefficient of refraction", known=True)
        slope = torch.zeros(len(more), dtype=torch.float64)
        slope[-1] = sigma
        return dataclasses.replace(more, refraction=refraction, by_refraction=slope)

    def and_effects(self, *names: str) -> SharedUnknowns:
        """These, and amounts of what shifts stars, landmarks or features together, in standard deviations."""
        more = self._and(*names, known=True)
        count = len(names)
        select = torch.zeros(count, len(more), dtype=torch.float64)
        select[:, len(more) - count :] = torch.eye(count, dtype=torch.float64)
        return dataclasses.replace(more, by_effects=select)

    def _and(self, *labels: str, known: bool) -> SharedUnknowns:
        """These, and more that change nothing yet."""

        def wider(part: Tensor) -> Tensor:
            return torch.nn.functional.pad(part, (0, len(labels)))

        return SharedUnknowns(
            cameras=tuple(map(wider, self.cameras)),
            shapes=self.shapes,
            board=wider(self.board),
            begin=wider(self.begin),
            known=torch.cat([self.known, torch.full((len(labels),), known)]),
            labels=(*self.labels, *labels),
            refraction=self.refraction,
            by_refraction=None if self.by_refraction is None else wider(self.by_refraction),
            by_effects=None if self.by_effects is None else wider(self.by_effects),
        )


def held(cameras: Sequence[Camera]) -> SharedUnknowns:
    """Nothing: cameras and board are as they are, and light is straight."""
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
