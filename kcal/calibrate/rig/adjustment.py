"""The joint adjustment with some items in and others out: building problems, and what each item's residual says."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Literal

import torch
from torch import Tensor

from kcal.calibrate.bundle.parameters import FreeParameters
from kcal.calibrate.bundle.views import free_parameters
from kcal.calibrate.rig.blocks import BoardGroup, FeatureGroup, Group, LandmarkGroup
from kcal.calibrate.rig.initial_poses import Start
from kcal.calibrate.rig.problem import DistanceTerm, ParameterTerm, PlaceTerm, RigProblem, SharedTerm
from kcal.calibrate.rig.sources import Boards, Features, Landmarks, RigData
from kcal.errors import InputError
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.result import Result, State
from kcal.solve.robust import RobustLoss

Intrinsics = Literal["fixed", "prior", "free"]
Source = Literal["boards", "landmarks", "features", "baselines", "positions"]
# px; of a corner.
_LEAST_SIGMA = 1e-3
# The kinds of items, in the order of masks.
KINDS: tuple[Source, ...] = ("boards", "landmarks", "features")
# Tensors of each group's local state: boards, landmarks, features.
TENSORS = (2, 1, 2)


def chi2_quantile(dof: Tensor, probability: float) -> Tensor:
    """Quantile of the χ² distribution by Wilson and Hilferty's cube (1931), good to a few percent from one degree on.

    Example:
        >>> round(float(chi2_quantile(torch.tensor(10.0), 0.999)), 1)  # 29.6 exactly
        29.8
    """
    spread = 2.0 / (9.0 * dof.clamp_min(1))
    return dof * (1.0 - spread + NormalDist().inv_cdf(probability) * spread.sqrt()) ** 3


class Adjustment:
    """Data, and the state of everything in it; `masks` say which boards, landmarks and features take part.

    Args:
        data: what is known.
        start: poses to begin with.
        intrinsics: whether parameters are held, solved with priors, or free.
        sigma_corner: of a board's corner, px.
        turning: which cameras' rotations are unknown; all but one that holds the frame if left out.
        moving: likewise their centers.
    """

    def __init__(
        self,
        data: RigData,
        start: Start,
        intrinsics: Intrinsics,
        sigma_corner: float,
        *,
        turning: Sequence[bool] | None = None,
        moving: Sequence[bool] | None = None,
    ) -> None:
        self.data, self.sigma_corner = data, sigma_corner
        loose = [data.absolute or c > 0 for c in range(len(data.cameras))]
        self._turning, self._moving = turning or loose, moving or loose
        self.anchor = start.center.mean(0)
        self.free = [_free(data, c, intrinsics) for c in range(len(data.cameras))]
        self.terms = _terms(data, self.free if intrinsics == "prior" else None)
        self.state: State = (
            torch.cat([camera.params.detach() for camera in data.cameras]),
            start.rotation,
            start.center,
            start.board_rotation,
            start.board_translation,
            data.landmarks.points if data.landmarks else torch.empty(0, 3, dtype=torch.float64),
            *_feature_start(data, start, self.anchor),
        )
        self._groups = _groups(data, self.anchor)

    def problem(self, masks: Sequence[Tensor], loss: RobustLoss | None = None, *, held: bool = False) -> RigProblem:
        """The problem of the items in the masks; `held`: of these alone, with the cameras as they are."""
        groups = [
            (build(mask, self.sigma_corner), count)
            for build, mask, count in zip(self._groups, masks, TENSORS, strict=True)
        ]
        count = len(self.data.cameras)
        free = [FreeParameters((), ())] * count if held else self.free
        turning, moving = ([not held and one for one in each] for each in (self._turning, self._moving))
        models, fields = [c.model for c in self.data.cameras], [c.field for c in self.data.cameras]
        return RigProblem(models, fields, groups, () if held else self.terms, free, turning, moving, loss)

    def part(self, masks: Sequence[Tensor]) -> State:
        """The state of the cameras and of the items in the masks."""
        out, start = list(self.state[:3]), 3
        for mask, count in zip(masks, TENSORS, strict=True):
            out += [tensor[mask] for tensor in self.state[start : start + count]]
            start += count
        return tuple(out)

    def put(self, state: State, masks: Sequence[Tensor]) -> None:
        """Keep a part's new state."""
        whole, start = [*state[:3], *(tensor.clone() for tensor in self.state[3:])], 3
        for mask, count in zip(masks, TENSORS, strict=True):
            for i in range(start, start + count):
                whole[i][mask] = state[i]
            start += count
        self.state = tuple(whole)

    def solve(
        self, masks: Sequence[Tensor], solver: LMOptions, loss: RobustLoss | None = None, *, held: bool = False
    ) -> tuple[RigProblem, Result]:
        """Minimize from where things are, and keep the result."""
        problem = self.problem(masks, loss, held=held)
        result = minimize(problem, self.part(masks), solver)
        self.put(problem.tidy(result.state), masks)
        return problem, result

    def squares(self, masks: Sequence[Tensor]) -> list[Tensor]:
        """χ² of every item as things stand; NaN for items outside the masks and infinite for what cannot be seen."""
        return _of_all(masks, self.problem(masks).block_squares(self.part(masks)))

    def deletions(self, masks: Sequence[Tensor]) -> list[Tensor]:
        """By how much χ² would fall without each item (`RigProblem.deletions`); NaN outside the masks."""
        return _of_all(masks, self.problem(masks).deletions(self.part(masks)))

    def freedom(self, masks: Sequence[Tensor]) -> list[Tensor]:
        """Degrees of freedom of every item beyond its own unknowns; 0 outside the masks."""
        found = []
        for mask, group in zip(masks, self.problem(masks).groups, strict=True):
            whole = torch.zeros(mask.shape, dtype=torch.int64)
            whole[mask] = group.counts - group.size
            found.append(whole)
        return found

    def fit_corners(self, masks: Sequence[Tensor], *, robust: bool = False) -> None:
        """Set the corners' sigma from the boards' residuals, unless it was given.

        Args:
            masks: the items that take part.
            robust: by the median board, so that some wrong ones do not matter.
        """
        boards = self.data.boards
        if boards is None or boards.sigma is not None or not bool(masks[0].any()):
            return
        squares, freedom = self.squares(masks)[0][masks[0]], self.freedom(masks)[0][masks[0]]
        dof = int(freedom.sum())
        excess = typical_excess(squares, freedom) if robust else float(squares.sum()) / max(dof, 1)
        if dof > 0 and 0 < excess < math.inf:
            # Noise-free corners would otherwise weigh infinitely much.
            self.sigma_corner = max(self.sigma_corner * math.sqrt(excess), _LEAST_SIGMA)


def _of_all(masks: Sequence[Tensor], values: Sequence[Tensor]) -> list[Tensor]:
    """Values of the items inside the masks put among all items: NaN for the others, infinite where there is none."""
    found = []
    for mask, part in zip(masks, values, strict=True):
        whole = torch.full(mask.shape, math.nan, dtype=torch.float64)
        whole[mask] = part.nan_to_num(math.inf, math.inf)
        found.append(whole)
    return found


def typical_excess(squares: Tensor, freedom: Tensor) -> float:
    """Median of χ² over what its median should be; 1 for fewer than four items."""
    known = (freedom > 0) & torch.isfinite(squares)
    if int(known.sum()) < 4:
        return 1.0
    return float((squares[known] / chi2_quantile(freedom[known].double(), 0.5)).median())


def _free(data: RigData, camera: int, intrinsics: Intrinsics) -> FreeParameters:
    model = data.cameras[camera].model
    if intrinsics == "fixed":
        return FreeParameters((), ())
    if intrinsics == "free":
        return FreeParameters.of(free_parameters(model))
    covariance = None if data.covariances is None else data.covariances[camera]
    if covariance is None:
        raise InputError(f"{data.names[camera]}: a prior needs the covariance of the camera's parameters")
    size = len(data.cameras[camera].names)
    if covariance.shape != (size, size):
        raise InputError(
            f"{data.names[camera]}: a covariance ({size}, {size}) is needed, {tuple(covariance.shape)} given"
        )
    if not bool(torch.isfinite(covariance).all()):
        raise InputError(f"{data.names[camera]}: the covariance of its parameters is not finite; calibrate it anew")
    return FreeParameters.of((covariance.diagonal() > 0).nonzero()[:, 0].tolist())


def _terms(data: RigData, priors: list[FreeParameters] | None) -> list[SharedTerm]:
    terms: list[SharedTerm] = [DistanceTerm(b.first, b.second, b.length, b.sigma) for b in data.baselines]
    terms += [PlaceTerm(p.camera, p.point, p.sigma) for p in data.positions]
    for c, free in enumerate(priors or ()):
        index = list(free)
        if not index:
            continue
        covariance = (data.covariances or ())[c]
        assert covariance is not None
        part = covariance[index][:, index]
        scale = part.diagonal().sqrt()
        factor, info = torch.linalg.cholesky_ex(part / scale[:, None] / scale)
        if int(info) != 0:
            raise InputError(f"{data.names[c]}: the covariance of its parameters is not positive definite")
        identity = torch.eye(len(index), dtype=torch.float64)
        white = torch.linalg.solve_triangular(factor, identity, upper=False) / scale
        terms.append(ParameterTerm(c, data.cameras[c].params.detach(), white))
    return terms


def _feature_start(data: RigData, start: Start, anchor: Tensor) -> tuple[Tensor, Tensor]:
    """Directions and inverse ranges: along the ray of the first camera that has one, at the range that is expected."""
    features = data.features
    if features is None:
        return torch.empty(0, 3, dtype=torch.float64), torch.empty(0, dtype=torch.float64)
    inverse = torch.where(torch.isfinite(features.inverse_range_sigma), features.inverse_range, 0.0)
    direction = torch.zeros(len(features.names), 3, dtype=torch.float64)
    direction[:, 2] = 1.0
    for c in reversed(range(len(data.cameras))):
        rays, valid = data.cameras[c].unproject(features.pixels[:, c])
        towards = rays @ start.rotation[c] - inverse[:, None] * (anchor - start.center[c])
        direction = torch.where(valid[:, None], towards, direction)
    return direction / torch.linalg.vector_norm(direction, dim=-1, keepdim=True), inverse


def _groups(data: RigData, anchor: Tensor) -> list:
    """For boards, landmarks and features a function of a mask and the corners' sigma that makes the group."""
    count = len(data.cameras)
    none = torch.empty(0, count, 1, 2, dtype=torch.float64)

    def marks(pixels: Tensor, sigma: float) -> Tensor:
        return (torch.eye(2, dtype=torch.float64) / sigma).expand(*pixels.shape, 2)

    def of_boards(mask: Tensor, sigma: float) -> Group:
        boards: Boards | None = data.boards
        if boards is None:
            return BoardGroup(none, marks(none, 1.0), torch.zeros(1, 3, dtype=torch.float64))
        return BoardGroup(boards.pixels[mask], boards.whitening(sigma)[mask], boards.board.points)

    def of_landmarks(mask: Tensor, sigma: float) -> Group:
        found: Landmarks | None = data.landmarks
        if found is None:
            empty = torch.empty(0, 3, dtype=torch.float64)
            return LandmarkGroup(none[:, :, 0], marks(none[:, :, 0], 1.0), empty, empty)
        pixels = found.pixels[mask]
        return LandmarkGroup(pixels, marks(pixels, found.pixel_sigma), found.points[mask], found.sigma[mask])

    def of_features(mask: Tensor, sigma: float) -> Group:
        found: Features | None = data.features
        if found is None:
            empty = torch.empty(0, dtype=torch.float64)
            return FeatureGroup(none[:, :, 0], marks(none[:, :, 0], 1.0), empty, empty, anchor)
        pixels = found.pixels[mask]
        known = found.inverse_range[mask], found.inverse_range_sigma[mask]
        return FeatureGroup(pixels, marks(pixels, found.pixel_sigma), *known, anchor)

    return [of_boards, of_landmarks, of_features]
