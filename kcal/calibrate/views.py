"""The views of one camera, and what a lens model may claim on them."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from kcal.calibrate.problem import BoardProblem
from kcal.lens.camera import Camera
from kcal.lens.inverse import valid_radius
from kcal.lens.model import LensModel
from kcal.lens.projection import INTRINSICS, parameter_names
from kcal.solve.result import State


@dataclasses.dataclass(frozen=True, kw_only=True)
class Views:
    """What a ladder is climbed on.

    Args:
        board_points: (N, 3) metres.
        pixels: (V, 1, N, 2) of one camera, NaN where not seen.
        size: (width, height) of the image.
        free_warp: whether the board's warp is estimated.
    """

    board_points: Tensor
    pixels: Tensor
    size: tuple[int, int]
    free_warp: bool

    def problem(self, model: LensModel, batch: tuple[int, ...] = (), radius: float | None = None) -> BoardProblem:
        """The least-squares problem of one lens model, which must be regular up to `radius` on the plane z = 1."""
        return BoardProblem(
            self.board_points,
            self.pixels,
            [model],
            [free_parameters(model)],
            free_warp=self.free_warp,
            guard=None if radius is None else _disc(radius),
            batch=batch,
        )

    def rms(self, state: State, model: LensModel) -> float:
        """Root mean square distance (pixels) between corners and their projections."""
        problem = self.problem(model)
        return math.sqrt(4.0 * float(problem.cost(state)) / problem.residual_count)

    def observed_radius(self, state: State) -> Tensor:
        """Largest undistorted radius at which a corner was seen."""
        *_, rotation, translation = state
        points = self.board_points @ rotation.transpose(-1, -2) + translation[..., None, :]
        radius = torch.linalg.vector_norm(points[..., :2] / points[..., 2:], dim=-1)
        seen = torch.isfinite(self.pixels[:, 0]).all(-1)
        return torch.where(seen, radius, 0.0).max()

    def trouble(self, state: State, model: LensModel) -> float:
        """0 for a lens that is regular in the whole image, 1 if it folds outside the observed radius, else infinity."""
        if not bool(valid_radius(state[0][len(INTRINSICS) :], model) > self.observed_radius(state)):
            return math.inf
        return 0.0 if bool(Camera(state[0], size=self.size, model=model).covers_image()) else 1.0


def _disc(radius: float) -> Tensor:
    """Points (3, K) on the plane z = 1, closer together than a pole or fold of a rational lens is wide."""
    r = torch.linspace(0.0, radius, 49, dtype=torch.float64)[1:]
    turn = torch.linspace(0.0, 2.0 * math.pi, 13, dtype=torch.float64)[:-1]
    x, y = torch.outer(r, torch.cos(turn)).flatten(), torch.outer(r, torch.sin(turn)).flatten()
    return torch.stack([x, y, torch.ones_like(x)])


def free_parameters(model: LensModel) -> list[int]:
    """Indices of all parameters but the skew."""
    return [i for i, name in enumerate(parameter_names(model)) if name != "skew"]
