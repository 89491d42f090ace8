"""Find corners and views that noise cannot explain, and solve without them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import torch
from torch import Tensor

from kcal.calibrate.camera.result import (
    CameraCalibrationResult,
    OutlierRejection,
    Progress,
    RejectedCorner,
    RejectedView,
)
from kcal.calibrate.problem.poses import spread_out
from kcal.calibrate.problem.views import LEAST_NOISE
from kcal.corners.observations import Observations
from kcal.errors import InputError
from kcal.texts import percent_text

# Expected number of good corners beyond the limit in a whole calibration, for normal noise.
_FALSE_CORNERS = 0.01
# The median of |x| of a normal variable is its standard deviation over this.
_MAD = 1.4826
# An outlying view has this many times the typical RMS, and is this many robust standard deviations above it.
_TIMES_TYPICAL, _VIEW_DEVIATIONS = 3.0, 5.0
# A view is left out whole if fewer of its corners are kept, as a number or as a share.
_MINIMUM_CORNERS, _MINIMUM_KEPT = 6, 0.5
# Largest number of fits; one or two are the rule.
_ROUNDS = 5


F = TypeVar("F")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Kept(Generic[F]):
    """What is left of observations, and its fit.

    Args:
        fit: of what is left.
        views: indices of the views that are left.
        rejected: (V, N) corners of these that are left out.
        rejected_views: the others.
    """

    fit: F
    views: list[int]
    rejected: Tensor
    rejected_views: tuple[RejectedView, ...]

    def complete(
        self, result: CameraCalibrationResult, observations: Observations, plain: Tensor, weighted: Tensor
    ) -> CameraCalibrationResult:
        """A result for these views as one for all observations: NaN for views left out, all rejections listed.

        Args:
            result: of the views that are left.
            observations: all.
            plain: (V, N, 2) residuals of all corners of these views, pixels.
            weighted: the same by the corners' weights.
        """
        limits = corner_limits(torch.where(self.rejected[..., None], torch.nan, weighted))
        corners = tuple(
            RejectedCorner(
                view=observations.names[self.views[i]],
                corner=n,
                residual=float(plain[i, n].norm()),
                reason=f"{float(weighted[i, n].norm()):.2f} px off, noise explains {float(limits[i]):.2f} px"
                if bool(torch.isfinite(plain[i, n]).all())
                else "the lens does not reach it",
            )
            for i, n in self.rejected.nonzero().tolist()
        )
        return dataclasses.replace(
            result.among(self.views, observations), rejected_corners=corners, rejected_views=self.rejected_views
        )


def leave_out_outliers(
    observations: Observations,
    rejection: OutlierRejection,
    robust: Tensor,
    fit: Callable[[list[int], Tensor], tuple[F, Tensor]],
    progress: Progress,
) -> Kept[F]:
    """Fit without outliers, and look for them again, until nothing changes.

    Corners of the remaining views are tested anew in every round, so that one that was rejected beside a worse one can
    come back.

    Args:
        observations: all.
        rejection: how much may be left out.
        robust: (V, N, 2) weighted residuals at a solution that a few wrong corners do not spoil; NaN where not seen,
            infinite where the lens does not reach a corner.
        fit: fits some views (indices) without some of their corners (V, N), and returns such residuals of all of them.
        progress: see `calibrate_camera`.
    """
    pixels, names = observations.pixels(), observations.names
    seen = torch.isfinite(pixels).all(-1)
    left, rejected = list(range(len(pixels))), torch.zeros_like(seen)
    gone: list[RejectedView] = []
    found: F | None = None
    residuals = robust
    for _ in range(_ROUNDS):
        beyond = corners_beyond(residuals)
        views = views_beyond(observations.board.points, residuals, pixels[left], beyond)
        if found is not None and not views and bool((beyond == rejected).all()):
            break
        rms = view_rms(residuals, beyond)
        for i, reason in views.items():
            count = int(seen[left[i]].sum())
            gone.append(RejectedView(view=names[left[i]], corners=count, residual=float(rms[i]), reason=reason))
        kept = [i for i in range(len(left)) if i not in views]
        left, rejected = [left[i] for i in kept], beyond[kept]
        lost = int(rejected.sum()) + sum(view.corners for view in gone)
        check_share(lost, int(seen.sum()), gone, rejection.limit)
        progress(f"{int(rejected.sum())} corners and {len(gone)} views left out")
        found, residuals = fit(left, rejected)
    assert found is not None
    return Kept(fit=found, views=left, rejected=rejected, rejected_views=tuple(gone))


def noise_scale(residuals: Tensor) -> Tensor:
    """Robust standard deviation along an axis of residuals (..., N, 2), NaN where there is none: (...).

    Example:
        >>> residuals = torch.randn(500, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
        >>> residuals[:10] = 1e6
        >>> 0.9 < float(noise_scale(residuals)) < 1.1
        True
    """
    # Where the lens does not reach most corners, the others tell nothing.
    return (_MAD * residuals.abs().flatten(-2).nanmedian(-1).values).nan_to_num(0.0, posinf=0.0)


def corner_limits(residuals: Tensor) -> Tensor:
    """The length (V,) beyond which residuals (V, N, 2) of each view are outliers.

    Two normal components of standard deviation σ are longer than t σ with probability exp(-t² / 2). With
    t = √(2 ln(n / 0.01)), 0.01 of n corners are expected beyond the limit, for any n. σ is 1.4826 times the median of
    |residual| of the view or of all views, whichever is larger, so that blurred views keep their corners.
    """
    count = max(int(torch.isfinite(residuals).all(-1).sum()), 1)
    scale = torch.maximum(noise_scale(residuals), noise_scale(residuals.flatten(0, 1))).clamp_min(LEAST_NOISE)
    return scale * math.sqrt(2.0 * math.log(count / _FALSE_CORNERS))


def corners_beyond(residuals: Tensor, times: float = 1.0) -> Tensor:
    """Which corners (V, N) of residuals (V, N, 2), NaN where not seen, are beyond `times` the limit."""
    return torch.linalg.vector_norm(residuals.nan_to_num(0.0), dim=-1) > times * corner_limits(residuals)[:, None]


def views_beyond(board_points: Tensor, residuals: Tensor, pixels: Tensor, rejected: Tensor) -> dict[int, str]:
    """Which views are outliers, with the reason.

    Args:
        board_points: (N, 3).
        residuals: (V, N, 2), NaN where not seen.
        pixels: (V, N, 2), NaN where not seen.
        rejected: (V, N) corners that are left out.
    """
    seen = torch.isfinite(pixels).all(-1)
    kept = seen & ~rejected
    count, had = kept.sum(-1), seen.sum(-1)
    rms = view_rms(residuals, rejected)
    middle = rms.nanmedian()
    spread = _MAD * (rms - middle).abs().nanmedian()
    limit = float(torch.maximum(_TIMES_TYPICAL * middle, middle + _VIEW_DEVIATIONS * spread).clamp_min(LEAST_NOISE))
    plane = spread_out(board_points, torch.where(kept[..., None], pixels, torch.nan))
    found: dict[int, str] = {}
    for i in range(len(pixels)):
        if int(count[i]) < max(_MINIMUM_CORNERS, _MINIMUM_KEPT * int(had[i])):
            found[i] = f"only {int(count[i])} of its {int(had[i])} corners agree with the other views"
        elif not bool(plane[i]):
            found[i] = "the corners that agree with the other views lie on one line"
        elif float(rms[i]) > limit:
            found[i] = f"its RMS is {float(rms[i]):.2f} px, typical are {float(middle):.2f} px"
    return found


def view_rms(residuals: Tensor, rejected: Tensor) -> Tensor:
    """RMS distance (V,) of the corners that are kept; NaN where none is."""
    kept = torch.isfinite(residuals).all(-1) & ~rejected
    squared = torch.where(kept, residuals.nan_to_num(0.0).square().sum(-1), 0.0)
    return torch.sqrt(squared.sum(-1) / kept.sum(-1))


def without(observations: Observations, views: Sequence[int], rejected: Tensor) -> Observations:
    """The observations of some views only, without the corners (V, N) of these views that are rejected."""
    kept = []
    for i, gone in zip(views, rejected.tolist(), strict=True):
        view = observations.views[i]
        if any(gone):
            update: dict[str, object] = {
                "pixels": tuple(None if out else value for value, out in zip(view.pixels, gone, strict=True))
            }
            if view.covariance is not None:
                update["covariance"] = tuple(
                    None if out else value for value, out in zip(view.covariance, gone, strict=True)
                )
            view = view.model_copy(update=update)
        kept.append(view)
    return observations.model_copy(update={"views": tuple(kept)})


def check_share(gone: int, total: int, views: Sequence[RejectedView], limit: float) -> None:
    """Raise `InputError` where more than the limit would be left out."""
    if gone <= limit * total:
        return
    names = ", ".join(view.view for view in views[:5]) + (" ..." if len(views) > 5 else "")
    raise InputError(
        f"{gone} of {total} corners ({percent_text(gone / total)})"
        + (f", with the whole views {names}," if views else "")
        + f" do not agree with the rest, more than the {100 * limit:.0f} % that may be left out (--reject-limit). "
        "Check the board, its size, the corners' order, the lens model, and these images"
    )
