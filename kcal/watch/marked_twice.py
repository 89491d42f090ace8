"""How cameras have turned, from marks of the same static points then and now; and whether they moved instead.

A camera that turns about its center moves the images of points by amounts that do not depend on their distance. So each
camera is solved alone, from the differences between its marks now and then. What is the same in both cancels: errors of
the lens and of the rig. Equal marks give exactly no turn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

import kcal.calibrate.rig.adjustment as adjustment
from kcal.calibrate.rig.source import typical_ratio
from kcal.checks import beyond_chance, chi2_quantile, variance_factor
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import fit_turn, rotation_from_vector, seen_turned, vector_from_rotation
from kcal.lens.projection import FAR
from kcal.texts import length_text

_ROUNDS = 30
# A camera that slid moves near points more than far ones. Near points that agree on how far tell so: at least as many,
# each moved by so many sigmas, of which so large a share fits then.
_FEWEST_NEAR, _NEAR_SIGMAS, _AGREE = 3, 3.0, 0.8
_REFITS = 20


class CameraTurn(NamedTuple):
    """How one camera has turned.

    Attributes:
        vector: (3,) radians about its own axes: pitch, yaw, roll.
        covariance: (3, 3).
        off: (F, 2) px, marks now minus where the turn puts those of then; NaN where one of the two is missing.
        squares: (F,) χ² of these, without what a mark itself takes from the fit: two degrees of freedom; 0 where NaN.
    """

    vector: Tensor
    covariance: Tensor
    off: Tensor
    squares: Tensor


class CameraTurns(NamedTuple):
    """How cameras have turned, by features that stand still.

    Attributes:
        each: camera's turn; covariances are multiplied by the variance.
        used: (F,) features that have not moved.
        over_limit: (F,) χ² of each in the camera where it fits worst, over the largest that noise explains.
        variance: how many times larger the squares of residuals are than the sigma of the marks says, at least 1.
        moved: what near points tell of cameras that are elsewhere now, a sentence each.
    """

    each: list[CameraTurn]
    used: Tensor
    over_limit: Tensor
    variance: float
    moved: tuple[str, ...]


def camera_turns(
    cameras: Sequence[Camera], names: Sequence[str], then: Tensor, now: Tensor, sigma: Tensor | float,
    inverse_range: Tensor | None = None,
) -> CameraTurns:  # fmt: skip
    """Find how each camera has turned; features that moved are left out.

    Args:
        cameras: C cameras.
        names: of the cameras.
        then: (F, C, 2) marks in all cameras; NaN where there is none.
        now: (F, C, 2) likewise.
        sigma: of the difference between two marks along an axis, px; one number, or (F, C).
        inverse_range: (F, C) roughly, 1 / m from each camera, 0 where it is not known; None: no camera has moved.

    Raises:
        InputError: many features moved.
        DegenerateError: a camera has fewer than two features with marks then and now, or all in one place.
    """
    sigmas = torch.as_tensor(sigma, dtype=torch.float64).expand(then.shape[:2]).nan_to_num(1.0)
    views = [_MarksTwice(camera, then[:, c], now[:, c], sigmas[:, c, None]) for c, camera in enumerate(cameras)]
    known = torch.stack([view.known for view in views])
    for name, marked in zip(names, known, strict=True):
        if int(marked.sum()) < 2:
            raise DegenerateError(
                f"drift: two features or landmarks at least are needed; {name} has {int(marked.sum())} with marks "
                "then and now. More let wrong ones be found"
            )
    matched = known.any(0)
    found = [view.turn(matched, robust=True) for view in views]
    if (times := max(math.sqrt(_typical(turn)) for turn in found)) > adjustment.WRONG_AS_A_WHOLE:
        raise InputError(
            f"drift: no turn explains the marks: typically they are {times:.0f} times as far off as their sigma says; "
            "check names, the sigma of the marks and that the images are of these cameras"
        )
    moved = list[str]()
    for c, (view, turn) in enumerate(zip(views, found, strict=True)):
        shift = None if inverse_range is None else view.shift(inverse_range[:, c].nan_to_num(0.0), turn)
        if shift is not None:
            moved.append(f"the {names[c]} camera has moved by some {length_text(float(shift.norm()))}")
    used = torch.zeros_like(matched)
    limit = chi2_quantile(2.0, 1.0 - adjustment.FALSE_ALARM / int(known.sum()))
    for _ in range(_ROUNDS):
        # What is typical of a camera counts as its noise.
        over = torch.stack([turn.squares / (max(1.0, _typical(turn)) * limit) for turn in found]).amax(0)
        before, used = used, matched & (over <= 1.0)
        if torch.equal(before, used):
            break
        gone, total = int((matched & ~used).sum()), int(matched.sum())
        if gone > max(1, adjustment.MOST_WRONG * total):
            raise InputError(
                f"{gone} of {total} features have moved against the rest: these are not a few; check names, the sigma "
                "of the marks and that the images are of these cameras"
            )
        found = [view.turn(used) for view in views]
    each = zip(found, views, strict=True)
    chi2 = sum(float((turn.off / view.sigma)[used].nan_to_num().square().sum()) for turn, view in each)
    freedom = 2 * int((known & used).sum()) - 3 * len(cameras)
    variance = variance_factor(chi2, freedom)
    each_turn = [turn._replace(covariance=variance * turn.covariance) for turn in found]
    return CameraTurns(each_turn, used, over, variance, tuple(moved))


class _MarksTwice:
    """Marks in one camera then and now, (F, 2), and the sigma (F, 1) of their difference along an axis."""

    def __init__(self, camera: Camera, then: Tensor, now: Tensor, sigma: Tensor) -> None:
        self.camera, self.sigma = camera, sigma
        rays, valid = camera.unproject(then)
        self.known = valid & torch.isfinite(now).all(-1)
        self.points = FAR * rays
        # The marks of then as they come back from their rays: equal marks leave no rounding.
        self.moved = now - then + self._project(torch.eye(3, dtype=torch.float64))[0]

    def _project(self, rotation: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (F, 2) of the points after a turn, and their derivatives (F, 2, 3) by a further one."""
        pixels, rows = seen_turned(self.camera, self.points, rotation)
        return pixels.T, rows[:3].permute(2, 1, 0)

    def turn(self, used: Tensor, *, robust: bool = False) -> CameraTurn:
        """The turn that takes the marks of then to those of now."""
        used, sigma = used & self.known, self.sigma

        def weighted(rotation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            pixels, rows = self._project(rotation)
            scaled = torch.where(self.known[:, None], self.moved - pixels, torch.nan) / sigma
            loss = adjustment.LOSS.weight(0.5 * scaled.square().sum(-1)) if robust else torch.ones_like(scaled[:, 0])
            return torch.where(used, loss.sqrt(), 0.0), rows / sigma[..., None], scaled

        def look(rotation: Tensor, _: Tensor) -> tuple[Tensor, Tensor]:
            root, rows, scaled = weighted(rotation)
            return (root[:, None, None] * rows).flatten(0, 1), -(root[:, None] * scaled).flatten()

        turn = fit_turn(torch.eye(3, dtype=torch.float64), look, settled=1e-12).rotation
        root, rows, scaled = weighted(turn)
        seen = root[:, None, None] * rows
        information = torch.einsum("nik,nil->kl", seen, seen)
        values = torch.linalg.eigvalsh(information)
        if not bool(values[0] > 1e-12 * values[2]):
            raise DegenerateError("drift: marks in one place do not determine how a camera has turned; add others")
        covariance = torch.linalg.inv(information)
        # What a mark takes from the fit makes its residual smaller; one that was left out has the fit's error on top.
        share = torch.zeros_like(covariance[:2, :2]) if robust else rows @ covariance @ rows.mT
        spread = torch.eye(2, dtype=torch.float64) + torch.where(used[:, None, None], -share, share)
        squares = torch.einsum("ni,nij,nj->n", scaled, torch.linalg.pinv(spread, rtol=1e-6, hermitian=True), scaled)
        return CameraTurn(vector_from_rotation(turn), covariance, sigma * scaled, squares.nan_to_num())

    def shift(self, inverse_range: Tensor, turn: CameraTurn) -> Tensor | None:
        """(3,) by how much points seem shifted in the camera's frame, m; None unless that is beyond doubt.

        `turn` is roughly the camera's own.
        """
        pixels, rows = seen_turned(self.camera, self.points, rotation_from_vector(turn.vector))
        slopes = torch.cat([rows[:3], rows[3:] * FAR * inverse_range]).permute(2, 1, 0) / self.sigma[..., None]
        scaled, here = (self.moved - pixels.T) / self.sigma, self.known & slopes.isfinite().all(-1).all(-1)
        scaled, slopes, costs = scaled[here], slopes[here], list[Tensor]()
        for count in (3, 6):
            # With turns alone, and with shifts, too.
            weight = torch.ones_like(scaled[:, :1])
            for _ in range(_REFITS):
                design, right = (weight[..., None] * slopes[..., :count]).flatten(0, 1), (weight * scaled).flatten()
                found = torch.linalg.lstsq(design, right[:, None], driver="gelsd").solution[:, 0]
                squares = (scaled - slopes[..., :count] @ found).square().sum(-1)
                weight = adjustment.LOSS.weight(0.5 * squares).sqrt()[:, None]
            costs.append(2.0 * adjustment.LOSS.value(0.5 * squares))
        # What is typical counts as noise.
        noise = max(1.0, typical_ratio(squares, torch.full_like(squares, 2.0)))
        near = (slopes[..., 3:] @ found[3:]).norm(dim=-1) > _NEAR_SIGMAS * math.sqrt(noise)
        agree = near & (squares < noise * chi2_quantile(2.0, 1.0 - adjustment.FALSE_ALARM))
        # Without the point that tells most, which may be one that moved itself.
        gain = (costs[0] - costs[1]) / noise
        certain = len(gain) > _FEWEST_NEAR and beyond_chance(float(gain.sum() - gain.max()), 3)
        enough = int(agree.sum()) >= max(_FEWEST_NEAR, _AGREE * int(near.sum()))
        return found[3:] if certain and enough else None


def _typical(turn: CameraTurn) -> float:
    """How much larger χ² typically is than the sigma of the marks says."""
    return typical_ratio(turn.squares, 2.0 * torch.isfinite(turn.off).all(-1))
