"""Corners and views that noise cannot explain: found, listed, and left out where the user asks for it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.bundle.closed_form import spread_out
from kcal.corners.observations import Observations
from kcal.errors import InputError

# How many good corners of a whole calibration may be expected beyond the limit, were their noise normal.
_FALSE_CORNERS = 0.01
# The median of |x| of a normal variable is its standard deviation over this.
_MAD = 1.4826
# Pixels; where data are exact, a thousandth of a pixel counts as their noise.
_LEAST_NOISE = 1e-3
# A view stands out by this many times the typical RMS, and by this many robust standard deviations of all views' RMS.
_TIMES_TYPICAL, _VIEW_DEVIATIONS = 3.0, 5.0
_MINIMUM_CORNERS = 6
_MINIMUM_KEPT = 0.5


@dataclasses.dataclass(frozen=True, kw_only=True)
class OutlierRejection:
    """How much `calibrate_camera` may leave out when it is asked to leave out what noise cannot explain.

    Args:
        limit: greatest share of all corners, those of left-out views counted. Beyond it nothing is left out: the
            calibration is refused, because data or model are wrong as a whole.
    """

    limit: float = 0.1

    def __post_init__(self) -> None:
        if not 0 < self.limit < 0.5:
            raise InputError(f"OutlierRejection: limit must be between 0 and 0.5, got {self.limit}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RejectedCorner:
    """A corner that was left out.

    Args:
        view: name of its view.
        corner: its index on the board.
        residual: pixels between it and its projection by the camera that was calibrated without it.
        reason: one sentence.
    """

    view: str
    corner: int
    residual: float
    reason: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class RejectedView:
    """A view that was left out.

    Args:
        view: its name.
        corners: how many corners it had.
        residual: its RMS in pixels when it was last part of the calibration, without corners left out before.
        reason: one sentence.
    """

    view: str
    corners: int
    residual: float
    reason: str


def noise_scale(residuals: Tensor) -> Tensor:
    """Robust standard deviation along an axis of residuals (..., N, 2), NaN where there is none: (...).

    Example:
        >>> residuals = torch.randn(500, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
        >>> residuals[:10] = 1e6
        >>> 0.9 < float(noise_scale(residuals)) < 1.1
        True
    """
    return (_MAD * residuals.abs().flatten(-2).nanmedian(-1).values).nan_to_num(0.0)


def corner_limits(residuals: Tensor) -> Tensor:
    """Beyond which length residuals (V, N, 2) of each view stand out: (V,) in their units.

    Two normal components of standard deviation σ are longer than t σ with probability exp(-t² / 2). With
    t = √(2 ln(n / 0.01)) of n corners a hundredth is expected beyond the limit, at any n. σ is 1.4826 times the median
    of |residual|, of the view or of all views, whichever is larger: views of unequal sharpness keep their corners.
    """
    count = max(int(torch.isfinite(residuals).all(-1).sum()), 1)
    scale = torch.maximum(noise_scale(residuals), noise_scale(residuals.flatten(0, 1))).clamp_min(_LEAST_NOISE)
    return scale * math.sqrt(2.0 * math.log(count / _FALSE_CORNERS))


def corners_beyond(residuals: Tensor, times: float = 1.0) -> Tensor:
    """Which corners (V, N) of residuals (V, N, 2), NaN where not seen, are beyond `times` the limit."""
    return torch.linalg.vector_norm(residuals.nan_to_num(0.0), dim=-1) > times * corner_limits(residuals)[:, None]


def views_beyond(board_points: Tensor, residuals: Tensor, pixels: Tensor, rejected: Tensor) -> dict[int, str]:
    """Which views stand out, with the reason.

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
    limit = float(torch.maximum(_TIMES_TYPICAL * middle, middle + _VIEW_DEVIATIONS * spread).clamp_min(_LEAST_NOISE))
    plane = spread_out(board_points, torch.where(kept[..., None], pixels, torch.nan))
    found: dict[int, str] = {}
    for i in range(len(pixels)):
        if int(count[i]) < max(_MINIMUM_CORNERS, _MINIMUM_KEPT * int(had[i])):
            found[i] = f"only {int(count[i])} of its {int(had[i])} corners agree with the other views"
        elif not bool(plane[i]):
            found[i] = "the corners that agree with the other views lie on one line"
        elif float(rms[i]) > limit:
            found[i] = f"its RMS {float(rms[i]):.2f} px stands out: {float(middle):.2f} px is typical"
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
        f"{gone} of {total} corners ({100 * gone / total:.0f} %)"
        + (f", with the whole views {names}," if views else "")
        + f" do not agree with the rest, more than the {100 * limit:.0f} % that may be left out: the board, its size, "
        "the corners' order or the lens model is wrong, or these images are bad; nothing was left out"
    )
