"""Refuse rigs whose baseline is so open that intervals of ranges are wrong; widen intervals where that helps.

Marks fix directions and the baseline turns them into ranges: an inverse range is linear in everything but the place of
the second camera. So intervals are tried on rigs that are two standard deviations off the solution in that place. Each
has targets with exact marks; the solved rig gives ranges and intervals for these marks. Were everything linear, no
error could exceed two of its standard deviations.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.rig.blocks import FeatureBlock, RigState
from kcal.calibrate.rig.landmark_block import LandmarkBlock
from kcal.calibrate.rig.problem import RigProblem
from kcal.calibrate.rig.uncertainty import SharedCovariance, relative_rows
from kcal.errors import DegenerateError

# Measured on simulated landmarks (scripts/check/weak_geometry.py): up to the first ratio first-order intervals contain
# the truth as often as they should; above it, once they are widened by the ratio's square, at most three times. Hardly
# any set above the second ratio gave useful ranges, nor one whose baseline across the line of sight is open by half.
_LINEAR, _HOPELESS, _OPEN = 1.15, 3.0, 0.5
_WIDEST = 3.0
# Extents across over extents along from which landmarks are no longer in a line or plane, and an extent over the
# distance from which they are no longer in one place: only words depend on these.
_LINE, _PLANE, _CLUSTER = 0.15, 0.1, 0.1
# px: the least noise of a target's mark. Distances of targets in baselines: 250 m, 1 km and 5 km for 10 m.
_MARK, _DISTANCES = 0.1, (25.0, 100.0, 500.0)
_COLUMNS, _ROWS = 5, 3
_SIGMAS = 2.0
# From the middle of a cube to its corners, edges and faces.
_DIRECTIONS = torch.nn.functional.normalize(
    torch.tensor([way for way in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(way)], dtype=torch.float64)
)


def check_places(
    problem: RigProblem, state: RigState, covariance: SharedCovariance, names: Sequence[str], *, refuse: bool = True
) -> tuple[float, list[str]]:
    """By how much the standard deviations of a rig must be multiplied for its intervals to be right, and warnings.

    Args:
        problem: the problem.
        state: its solution.
        covariance: of the solution.
        names: of the cameras.
        refuse: raise an error where no range is known; otherwise a warning tells.

    Raises:
        DegenerateError: a camera whose place is so open that no range is known; what to add is told.
    """
    widen, warnings = 1.0, list[str]()
    for second in range(1, len(names)):
        found = open_place(problem, state, covariance, 0, second)
        if found is None or (found.ratio <= _LINEAR and found.share <= _OPEN):
            continue
        hopeless = not (found.ratio <= _HOPELESS and found.share <= _OPEN)
        baseline = float((state.center[second] - state.center[0]).norm())
        word = ("sideways", "up and down", "along its view")[int(found.direction.abs().argmax())]
        text = (
            f"the data {'do not' if hopeless else 'hardly'} determine where {names[second]} stands: "
            f"± {found.sigma:.2g} m ({word} as {names[0]} sees it) with a baseline of {baseline:.3g} m; "
        )
        advice = _advice(problem, state)
        if hopeless and refuse:
            raise DegenerateError(f"{text}ranges could be anything. {advice}")
        factor = min(max(found.ratio, 1.0) ** 2, _WIDEST)
        widen = max(widen, factor)
        effect = "ranges could be anything" if hopeless else f"intervals were widened {factor:.1f} times for that"
        warnings.append(f"{text}{effect}. {advice}")
    return widen, warnings


def _advice(problem: RigProblem, state: RigState) -> str:
    """What the landmarks have in common, and what to add."""
    measure = "or measure the positions of the cameras"
    if not any(isinstance(block, LandmarkBlock) for block in problem.blocks):
        return f"Add surveyed landmarks, {measure}"
    middle = state.points.mean(0)
    extent = torch.linalg.svdvals(state.points - middle) / math.sqrt(len(state.points))
    long, wide, thick = (*extent.tolist(), 0.0, 0.0)[:3]
    if long < _CLUSTER * float((state.center[0] - middle).norm()):
        return (
            "The landmarks are close together as the cameras see them: turning the rig about that place is not "
            f"determined; add landmarks far to the side of it and nearer ones, {measure}"
        )
    if wide < _LINE * long:
        return (
            "The landmarks lie nearly in one line: turning the rig about that line is not determined; add a landmark "
            f"well off the line, {measure}"
        )
    if thick < _PLANE * wide:
        return (
            "The landmarks lie nearly in one plane: their common distance stands for a turn of the cameras; add "
            f"landmarks well before or behind that plane, {measure}"
        )
    return f"Add landmarks that are nearer and spread over the image, mark them more precisely, {measure}"


class OpenPlace(NamedTuple):
    """How well a rig knows where its second camera stands.

    Attributes:
        share: standard deviation of the baseline across the line of sight, over its length across it; median over the
            first camera's image.
        ratio: of errors to what first-order intervals allow for, where it is largest; 1 or less if they are right.
        direction: (3,) unit vector along the first camera's axes in which the place is most open.
        sigma: its standard deviation in that direction, meters.
    """

    share: float
    ratio: float
    direction: Tensor
    sigma: float


class _Targets(NamedTuple):
    """Ray `rays[t]` of the first camera at inverse ranges, and what is known of an inverse range there.

    Attributes:
        rays: (T, 3) in the first camera's frame.
        near: the largest inverse range.
        half: (3, T, K) how an inverse range follows K independent standard normal errors of the rig, at infinity, at
            half of `near` and at `near`; a parabola in between.
        own: (T,) variance of an inverse range by its marks alone.
    """

    rays: Tensor
    near: float
    half: Tensor
    own: Tensor

    def at(self, inverse_range: Tensor) -> Tensor:
        """`half` (..., T, K) at inverse ranges (..., T)."""
        share = (inverse_range / self.near)[..., None]
        weights = (1.0 - share) * (1.0 - 2.0 * share), 4.0 * share * (1.0 - share), share * (2.0 * share - 1.0)
        return sum((weight * node for weight, node in zip(weights, self.half, strict=True)), torch.zeros(()))


def open_place(
    problem: RigProblem, state: RigState, covariance: SharedCovariance, first: int, second: int
) -> OpenPlace | None:
    """Tell how open the place of the second camera is; None where the data do not determine all of the rig."""
    rotation = state.rotation[second] @ state.rotation[first].T
    center = state.rotation[first] @ (state.center[second] - state.center[first])
    half = covariance.half_of(relative_rows(problem, state, first, second))
    inverse = 1.0 / (torch.tensor(_DISTANCES, dtype=torch.float64) * center.norm())
    targets = _targets(problem, state, covariance, (first, second), float(inverse[0]))
    if half is None or targets is None:
        return None
    turns, moves = half[:, :3], half[:, 3:]
    # The second center in the first frame is -Rᵀ t.
    places = -(moves + torch.linalg.cross((rotation @ center).expand_as(turns), turns)) @ rotation
    axes, sigmas, ways = torch.linalg.svd(places.T, full_matrices=False)
    across = torch.eye(3, dtype=torch.float64) - targets.rays[:, :, None] * targets.rays[:, None, :]
    share = torch.linalg.matrix_norm(across @ places.T, 2) / (across @ center).norm(dim=-1)
    steps = _SIGMAS * _DIRECTIONS @ ways
    true = inverse[:, None, None]

    def seen_from(moved: Tensor) -> tuple[Tensor, Tensor]:
        """Inverse ranges (D, W, T) that are found for targets at D distances seen from W places, and their rays."""
        there = targets.rays - true[..., None] * (center + moved)[:, None]
        sight = torch.nn.functional.normalize(there, dim=-1)
        base = center - (sight @ center)[..., None] * sight
        return (base * targets.rays).sum(-1) / base.square().sum(-1), there

    # Turns and lenses, which trade with each other by far more than both together are off, count to first order.
    found, seen = seen_from(steps @ places)
    by_place = _first_order(targets.rays, true, center, steps @ places)
    found = found - by_place - (targets.at(true.expand_as(found)) @ steps[:, :, None])[..., 0]
    variance = targets.own + targets.at(found).square().sum(-1)
    errors = (found - true).square() / variance
    common = _common(problem, second, seen @ rotation.T)
    mean = torch.where(common, errors.nan_to_num(math.inf), 0.0).sum(-1) / common.sum(-1).clamp_min(1)
    return OpenPlace(float(share.median()), math.sqrt(float(mean.max())) / _SIGMAS, axes[:, 0], float(sigmas[0]))


def _first_order(rays: Tensor, true: Tensor, center: Tensor, moved: Tensor) -> Tensor:
    """(D, W, T) change of the inverse ranges of targets by W moves (W, 3) of the second center, to first order.

    With s the unit vector from that center c to a target and r the ray, the inverse range is found as
    (c r - (s c)(s r)) / (c c - (s c)²), where c is not known to have moved.
    """
    there = rays - true[..., None] * center
    length = there.norm(dim=-1, keepdim=True)
    sight = there / length
    turned = -true[..., None] * moved[:, None] / length
    turned = turned - (turned * sight).sum(-1, keepdim=True) * sight
    p, q = sight @ center, (sight * rays).sum(-1)
    dp, dq = turned @ center, (turned * rays).sum(-1)
    square = center @ center - p * p
    found = (rays @ center - p * q) / square
    return (2.0 * found * p * dp - dp * q - p * dq) / square


def _common(problem: RigProblem, second: int, points: Tensor) -> Tensor:
    """Which points (..., 3) in the second camera's frame it sees."""
    camera = problem.cameras[second]
    pixels, valid = camera.project(points)
    return valid & camera.inside(pixels)


def _targets(
    problem: RigProblem, state: RigState, covariance: SharedCovariance, pair: tuple[int, int], near: float
) -> _Targets | None:
    """Targets all over the first camera's image."""
    camera, first = problem.cameras[pair[0]], pair[0]
    across, down = (
        (torch.arange(count).double() + 0.5) * size / count - 0.5
        for count, size in zip((_COLUMNS, _ROWS), camera.size, strict=True)
    )
    rays, valid = camera.unproject(torch.stack(torch.meshgrid(across, down, indexing="xy"), -1).reshape(-1, 2))
    rays = rays[valid]
    direction, count = (rays @ state.rotation[first]).repeat(3, 1), 3 * len(rays)
    inverse = torch.tensor([0.0, 0.5 * near, near], dtype=torch.float64).repeat_interleave(len(rays))
    pixels = torch.full((count, len(problem.cameras), 2), torch.nan, dtype=torch.float64)
    pixels[:, list(pair)] = 0.0
    nothing = torch.zeros(count, dtype=torch.float64), torch.full((count,), torch.inf, dtype=torch.float64)
    whitening = (torch.eye(2, dtype=torch.float64) / _MARK).expand(*pixels.shape, 2)
    block = FeatureBlock(pixels, whitening, *nothing, state.center[first])
    turning, moving = ([slot is not None for slot in slots] for slots in (problem.turn, problem.shift))
    alone = RigProblem(problem.cameras, [block], (), problem.unknowns, turning, moving)
    follow, own = alone.response(state._replace(direction=direction, inverse_range=inverse), block)
    rows = follow[:, -1].clone()
    slot = problem.shift[first]
    if slot is not None:
        # The range is from where the first camera stands, not from where it was found.
        rows[:, slot] += inverse.square()[:, None] * direction
    half = covariance.half_of(rows)
    if half is None or not len(rays):
        return None
    own = own.unflatten(0, (3, -1))[0, :, -1, -1]
    return _Targets(rays, near, half.T.unflatten(0, (3, -1)), own)
