"""Find how cameras have turned, from marks of the same static things then and now.

A camera that turns about its center moves the images of things by amounts that do not depend on their distance. So each
camera is solved alone, from the differences between its marks now and then. What is the same in both cancels: errors of
the lens and of the rig. Equal marks give exactly no turn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.rig.adjustment import typical_ratio
from kcal.calibrate.rig.limits import FALSE_ALARM
from kcal.calibrate.rig.outliers import LOSS, MOST_WRONG, WRONG_AS_A_WHOLE
from kcal.calibrate.rig.result import ItemResidual
from kcal.calibrate.rig.sources import Features
from kcal.chance import chi2_quantile, variance_factor
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector, step_rows, vector_from_rotation
from kcal.lens.projection import project_components
from kcal.lens.pupil import FAR

_STEPS, _ROUNDS = 50, 30


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


def camera_turns(
    cameras: Sequence[Camera], names: Sequence[str], features: Features
) -> tuple[list[CameraTurn], tuple[ItemResidual, ...], float]:
    """Find how each camera has turned; features that moved are left out.

    Args:
        cameras: C cameras.
        names: of the cameras.
        features: pixels (F, 2 C, 2): in all cameras then, and in all now. What is known of ranges is not used.

    Returns:
        each camera's turn; the residuals of the features; and by how much the covariances were multiplied because
        residuals are larger than the marks' sigma explains.

    Raises:
        InputError: many features moved.
        DegenerateError: a camera has fewer than two features with marks then and now, or all in one place.
    """
    then, now = features.pixels.unflatten(1, (2, len(cameras))).unbind(1)
    views = [_MarksTwice(camera, then[:, c], now[:, c]) for c, camera in enumerate(cameras)]
    known = torch.stack([view.known for view in views])
    for name, marked in zip(names, known, strict=True):
        if int(marked.sum()) < 2:
            raise DegenerateError(
                f"drift: two features or landmarks at least are needed; {name} has {int(marked.sum())} with marks "
                "then and now. More let wrong ones be found"
            )
    matched, sigma = known.any(0), math.sqrt(2.0) * features.pixel_sigma
    found = [view.turn(matched, sigma, robust=True) for view in views]
    if (times := max(math.sqrt(_typical(turn)) for turn in found)) > WRONG_AS_A_WHOLE:
        raise InputError(
            f"drift: no turn explains the marks: typically they are {times:.0f} times as far off as their sigma says; "
            "check names, the sigma of the marks and that the images are of these cameras"
        )
    used = torch.zeros_like(matched)
    for _ in range(_ROUNDS):
        over = torch.stack([_over_limit(turn, known) for turn in found]).amax(0)
        before, used = used, matched & (over <= 1.0)
        if torch.equal(before, used):
            break
        gone, total = int((matched & ~used).sum()), int(matched.sum())
        if gone > max(1, MOST_WRONG * total):
            raise InputError(
                f"{gone} of {total} features have moved against the rest: these are not a few; check names, the sigma "
                "of the marks and that the images are of these cameras"
            )
        found = [view.turn(used, sigma) for view in views]
    chi2 = sum(float((turn.off[used].nan_to_num() / sigma).square().sum()) for turn in found)
    freedom = 2 * int((known & used).sum()) - 3 * len(cameras)
    variance = variance_factor(chi2, freedom)
    items = []
    for i, feature in enumerate(features.names):
        off = {name: float(turn.off[i].norm()) for name, turn in zip(names, found, strict=True)}
        off = {name: length for name, length in off.items() if math.isfinite(length)}
        moved = ", ".join(f"{length:.1f} px ({name})" for name, length in off.items())
        reason = f"it has moved by {moved}" if off else "no camera has a mark of it both then and now"
        items.append(
            ItemResidual(
                source="features",
                name=feature,
                pixels=tuple(off.get(name) for name in names),
                sigmas=math.hypot(*off.values()) / (sigma * math.sqrt(2 * len(off))) if off else math.inf,
                over_limit=float(over[i]),
                used=bool(used[i]),
                reason="" if used[i] else reason,
            )
        )
    return [turn._replace(covariance=variance * turn.covariance) for turn in found], tuple(items), variance


class _MarksTwice:
    """Marks in one camera then and now, (F, 2)."""

    def __init__(self, camera: Camera, then: Tensor, now: Tensor) -> None:
        self.camera = camera
        rays, valid = camera.unproject(then)
        self.known = valid & torch.isfinite(now).all(-1)
        self.points = FAR * rays
        # The marks of then as they come back from their rays: equal marks leave no rounding.
        self.moved = now - then + self._project(self.points)[0]

    def _project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (F, 2) of points, and their derivatives (F, 2, 3) by a turn."""
        seen = project_components(points.T, self.camera.params.detach(), self.camera.model, ())
        return seen.pixels.T, step_rows(seen.by_point, points.T)[:3].permute(2, 1, 0)

    def turn(self, used: Tensor, sigma: Tensor | float, *, robust: bool = False) -> CameraTurn:
        """The turn that takes the marks of then to those of now; `sigma` of their difference along an axis."""
        used, turn = used & self.known, torch.eye(3, dtype=torch.float64)
        for _ in range(_STEPS):
            pixels, rows = self._project(self.points @ turn.T)
            off = torch.where(self.known[:, None], self.moved - pixels, torch.nan)
            rows, scaled = rows / sigma, off / sigma
            weight = used.double() * (LOSS.weight(0.5 * scaled.square().sum(-1)) if robust else 1.0)
            weight = torch.where(used, weight, 0.0)
            information = torch.einsum("n,nik,nil->kl", weight, rows, rows)
            values = torch.linalg.eigvalsh(information)
            if not bool(values[0] > 1e-12 * values[2]):
                raise DegenerateError("drift: marks in one place do not determine how a camera has turned; add others")
            step = torch.linalg.solve(information, torch.einsum("n,nik,ni->k", weight, rows, scaled.nan_to_num()))
            turn = rotation_from_vector(step) @ turn
            if float(step.norm()) < 1e-12:
                break
        covariance = torch.linalg.inv(information)
        # What a mark takes from the fit makes its residual smaller; one that was left out has the fit's error on top.
        share = torch.zeros_like(covariance[:2, :2]) if robust else rows @ covariance @ rows.mT
        spread = torch.eye(2, dtype=torch.float64) + torch.where(used[:, None, None], -share, share)
        squares = torch.einsum("ni,nij,nj->n", scaled, torch.linalg.pinv(spread, rtol=1e-6, hermitian=True), scaled)
        return CameraTurn(vector_from_rotation(turn), covariance, off, squares.nan_to_num())


def _typical(turn: CameraTurn) -> float:
    """How much larger χ² typically is than the sigma of the marks says."""
    return typical_ratio(turn.squares, 2.0 * torch.isfinite(turn.off).all(-1))


def _over_limit(turn: CameraTurn, known: Tensor) -> Tensor:
    """(F,) χ² of each mark over the largest that noise explains; what is typical of a camera counts as its noise."""
    level = 1.0 - FALSE_ALARM / int(known.sum())
    return turn.squares / (max(1.0, _typical(turn)) * chi2_quantile(2.0, level))
