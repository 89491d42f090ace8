"""The views of one camera, and what a lens model may claim on them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.bundle.board_problem import BoardProblem
from kcal.calibrate.bundle.parameters import Free, Rules
from kcal.calibrate.bundle.priors import Term
from kcal.lens.model import LensModel
from kcal.lens.projection import parameter_names, project_components
from kcal.solve.result import State

# How far beyond the outermost point a lens must be regular; the image's corners move a little with the lens.
_MARGIN = 1.05
# Where `Views.trouble` looks: directions of the disc, points of each side of the image, steps from the axis outward.
_DIRECTIONS, _SIDE, _STEPS = 16, 8, 250
_SHARES = (0.5, 0.8, 1.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Views:
    """What a ladder is climbed on.

    Args:
        board_points: (N, 3) meters.
        pixels: (V, 1, N, 2) of one camera, NaN where not seen.
        size: (width, height) of the image.
        free_warp: whether the board's warp is estimated.
        rules: what is known of the camera's parameters.
        prior_noise: pixels of a corner's noise, against which priors count.
    """

    board_points: Tensor
    pixels: Tensor
    size: tuple[int, int]
    free_warp: bool
    rules: Rules = dataclasses.field(default_factory=Rules)
    prior_noise: float = 0.3

    def problem(
        self, model: LensModel, batch: tuple[int, ...] = (), terms: Sequence[Term] = (), *, poses_only: bool = False
    ) -> BoardProblem:
        """The least-squares problem of one lens model, or of the poses (and the warp) under a given lens."""
        free = Free((), ()) if poses_only else self.rules.parameters(model)
        terms = (*terms, *self.rules.terms(model, self.prior_noise))
        return BoardProblem(
            self.board_points, self.pixels, [model], [free], free_warp=self.free_warp, terms=terms, batch=batch
        )

    def seen_radius(self, state: State) -> float:
        """Radius on the plane z = 1 around all corners that were seen, with a margin."""
        return _MARGIN * float(self.observed_radius(state))

    def regular_radius(self, state: State, model: LensModel) -> float:
        """Likewise around the whole image, if the lens reaches it."""
        rim = _rim(state[0], model, self.size)
        return self.seen_radius(state) if rim is None else max(self.seen_radius(state), _MARGIN * rim)

    def noise(self, state: State, model: LensModel) -> float:
        """Standard deviation (pixels) of the residuals along an axis."""
        problem = BoardProblem(self.board_points, self.pixels, [model], [()])
        return math.sqrt(2.0 * float(problem.cost(state)) / problem.residual_count)

    @property
    def corner_count(self) -> int:
        """How many corners were seen."""
        return int(torch.isfinite(self.pixels).all(-1).sum())

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
        """0 for a lens that is regular in the whole image, 1 if it folds outside the observed radius, else infinity.

        Looked at along some directions, in small steps: candidates of a search are many, and the one that is chosen
        is measured (`kcal.lens.region`) when its camera is made.
        """
        angle = torch.arange(_DIRECTIONS, dtype=torch.float64) * (2.0 * math.pi / _DIRECTIONS)
        disc = float(self.observed_radius(state)) * torch.stack([torch.cos(angle), torch.sin(angle)])
        if not _regular_up_to(disc, state[0], model):
            return math.inf
        border = _border(state[0], model, self.size)
        return 0.0 if border is not None and _regular_up_to(border, state[0], model) else 1.0


def _regular_up_to(ends: Tensor, parameters: Tensor, model: LensModel) -> bool:
    """Whether a lens is regular on the straight ways from the axis to points (2, K) of the plane z = 1."""
    steps = torch.linspace(0.0, 1.0, _STEPS + 1, dtype=torch.float64)[1:]
    places = (ends[..., None] * steps).flatten(1)
    points = torch.cat([places, torch.ones_like(places[:1])])
    return bool(project_components(points, parameters, model).regular.all())


def _rim(parameters: Tensor, model: LensModel, size: tuple[int, int]) -> float | None:
    """Largest radius on the plane z = 1 that the image's border shows; None where the lens does not reach it."""
    border = _border(parameters, model, size)
    return None if border is None else float(torch.hypot(*border).max())


def _border(parameters: Tensor, model: LensModel, size: tuple[int, int]) -> Tensor | None:
    """Places (2, K) on the plane z = 1 that the image's border shows; None where the lens does not reach all of it."""
    t = torch.linspace(0.0, 1.0, _SIDE + 1, dtype=torch.float64)[:-1]
    zero, one = torch.zeros_like(t), torch.ones_like(t)
    u, v = torch.cat([t, one, 1.0 - t, zero]), torch.cat([zero, t, one, 1.0 - t])
    border = torch.stack([u * (size[0] - 1.0), v * (size[1] - 1.0)])
    center = torch.stack([parameters[2], parameters[3]])[:, None]
    x, y = _SHARES[0] * (border - center) / torch.stack([parameters[0], parameters[1]])[:, None]
    for share in _SHARES:
        # Outward in stretches, because Newton's steps from afar may leave a strongly distorting lens.
        wanted = center + share * (border - center)
        for _ in range(12):
            seen = project_components(torch.stack([x, y, torch.ones_like(x)]), parameters, model, ())
            error = wanted - seen.pixels
            if not bool(seen.regular.all()):
                return None
            if float(error.abs().max()) < 1e-3:
                break
            ux, vx, uy, vy = seen.by_point[:2].flatten(0, 1)
            scale = 1.0 / (ux * vy - uy * vx)
            x, y = x + (vy * error[0] - uy * error[1]) * scale, y + (ux * error[1] - vx * error[0]) * scale
        else:
            return None
    return torch.stack([x, y])


def free_parameters(model: LensModel) -> list[int]:
    """Indices of all parameters but the skew."""
    return [i for i, name in enumerate(parameter_names(model)) if name != "skew"]
