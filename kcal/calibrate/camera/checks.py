"""Check the views of one camera before it is calibrated: what is missing, and what adds nothing."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Generic, TypeVar

import torch
from torch import Tensor

from kcal.calibrate.camera.result import CameraCalibrationResult, OutlierRejection, Progress, Rejected
from kcal.calibrate.problem.views import LEAST_NOISE, homographies, spread_out
from kcal.corners.observations import Observations
from kcal.errors import DegenerateError, InputError
from kcal.finding import Finding
from kcal.texts import counted_text, percent_text

# Find views of one camera that add nothing: copies of other views, and frames of a board that stands still.
#
# The corners of a copy, saved twice or compressed again, differ by far less than the residuals. Both views then have
# the same residuals, and counting them twice makes σ too small. Frames of a camera and a board that both stand still
# differ by the noise of the image: that averages, but errors of lens model and board are the same in all of them.

# Corners of a copy differ by less than this share of what independent noise does. Chance alone brings six corners so
# near each other in three pairs of a million.
_COPY_SHARE = 0.25
# Pixels that corners of a copy differ by at most. JPEG of quality 60 to 98 moves real corners by 0.0005 to 0.013 px.
_COPY_PIXELS = 0.03
# Two views show the same pose where corners differ by less than this share of their distance from their middle. A board
# that is held still moves by less; other poses differ by several times as much.
_POSE_SHARE = 0.05
# Two views are compared if they have this share of their corners in common.
_COMMON = 0.5
# Distances of so many views to all others are formed at a time; they are exact to this share of the sum of squares.
_AT_A_TIME, _ROUNDING = 256, 1e-12


def copied_views(pixels: Tensor, noise: float) -> dict[int, int]:
    """Which views are copies of earlier ones: index -> index of the first of them.

    Args:
        pixels: (V, N, 2), NaN where not seen.
        noise: px of a corner along an axis; with 0, copies have exactly the same corners.

    Example:
        >>> view = torch.rand(9, 2, dtype=torch.float64)
        >>> copied_views(torch.stack([view, view + 0.1, view + 1e-3, view]), noise=0.1)
        {2: 0, 3: 0}
    """
    return _alike(pixels, torch.full((len(pixels),), min(2.0 * _COPY_SHARE * noise, math.sqrt(2.0) * _COPY_PIXELS)))


def repeated_poses(pixels: Tensor) -> dict[int, int]:
    """Which views show the board where an earlier one does: index -> index of the first of them.

    Args:
        pixels: (V, N, 2), NaN where not seen.

    Example:
        >>> view = 100 * torch.rand(9, 2, dtype=torch.float64)
        >>> repeated_poses(torch.stack([view, view + 9.0, view + 0.1]))
        {2: 0}
    """
    spread = (pixels - pixels.nanmean(1, keepdim=True)).square().sum(-1).nanmean(-1).sqrt()
    return _alike(pixels, _POSE_SHARE * spread)


def _alike(pixels: Tensor, limit: Tensor) -> dict[int, int]:
    """Views whose corners have an RMS distance of at most `limit` (V,) from those of an earlier view, in no group."""
    seen = torch.isfinite(pixels).all(-1)
    first: dict[int, int] = {}
    for i, near in enumerate(_nearby(pixels, seen, limit)):
        others = [k for k in near if k not in first]
        if not others:
            continue
        common = (seen[i] & seen[others]).sum(-1)
        squared = (pixels[i] - pixels[others]).square().sum(-1).nansum(-1) / common
        comparable = common >= _COMMON * torch.maximum(seen[i].sum(), seen[others].sum(-1))
        alike = (comparable & (squared.sqrt() <= limit[i])).nonzero()[:, 0].tolist()
        if alike:
            first[i] = others[alike[0]]
    return first


def _nearby(pixels: Tensor, seen: Tensor, limit: Tensor) -> Iterator[list[int]]:
    """For each view the earlier ones that may be that near: none is missed, but rounding lets some through."""
    filled = torch.where(seen[..., None], pixels - pixels[seen].mean(0), 0.0)
    mask, flat, square = seen.to(pixels.dtype), filled.flatten(1), filled.square().sum(-1)
    slack = _ROUNDING * square.sum(-1).max()
    for start in range(0, len(pixels), _AT_A_TIME):
        some = slice(start, start + _AT_A_TIME)
        squared = square[some] @ mask.T + mask[some] @ square.T - 2.0 * flat[some] @ flat.T
        common = mask[some] @ mask.T
        near = (common > 0) & (squared <= limit[some, None].square() * common + slack)
        for i, row in enumerate(near, start=start):
            yield row[:i].nonzero()[:, 0].tolist()


def copy_findings(names: Sequence[str], copied: Mapping[int, int]) -> list[Finding]:
    """A doubt that names the copies."""
    if not copied:
        return []
    pairs = ", ".join(f"{names[i]} of {names[k]}" for i, k in list(copied.items())[:5])
    text = (
        f"{len(copied)} of {len(names)} views are copies of others ({pairs}{', ...' if len(copied) > 5 else ''}) and "
        "were left out: they add nothing, and σ would be too small with them"
    )
    return [Finding("copies", "doubt", text, "remove them")]


def pose_findings(pixels: Tensor) -> list[Finding]:
    """A doubt where most views show the board in the pose of another view."""
    views, repeated = len(pixels), len(repeated_poses(pixels))
    if 2 * repeated <= views:
        return []
    text = (
        f"{views} views show the board in {views - repeated} poses only: frames of one pose average noise, but errors "
        "of the lens model and the board are the same in all of them, and σ does not contain these"
    )
    return [Finding("repeated", "doubt", text, "move and tilt the board between views")]


# Check the views of one camera before it is calibrated.

MINIMUM_VIEWS = 3
# A homography has eight unknowns; six corners leave something to check them by.
_MINIMUM_CORNERS = 6
# RMS distance in pixels of a view's corners from the best line, below which they do not span a plane.
_MINIMUM_WIDTH = 0.5
# Views that are named where none fits, and how many times farther off a plane than the typical one they are.
_WORST, _BENT = 3, 3.0


def mirrored_views(board_points: Tensor, pixels: Tensor) -> Tensor:
    """(V,) whether the corners run the other way round, as on a board seen in a mirror.

    Args:
        board_points: (N, 3) meters.
        pixels: (V, N, 2), NaN where not seen.

    Example:
        >>> points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]).double()
        >>> mirrored_views(points, torch.stack([points[:, :2], -points[:, :2], points[:, :2].flip(1)])).tolist()
        [False, False, True]
    """
    seen = pixels.isfinite().all(-1, keepdim=True)
    flat = torch.where(seen, board_points[:, :2], torch.nan)
    # The sign of an affine map's determinant is that of the moments between both sides.
    flat = (flat - flat.nanmean(1, keepdim=True)).nan_to_num(0.0)
    return torch.linalg.det(flat.transpose(1, 2) @ torch.where(seen, pixels, 0.0)) < 0


def unusable_views(board_points: Tensor, pixels: Tensor) -> dict[int, str]:
    """Views whose corners do not determine the board's pose, or run the other way than in most: index -> why.

    Args:
        board_points: (N, 3) meters.
        pixels: (V, N, 2), NaN where not seen.
    """
    seen = torch.isfinite(pixels).all(-1).sum(-1)
    spread = spread_out(board_points, pixels)
    centered = torch.nan_to_num(pixels - pixels.nanmean(1, keepdim=True))
    width = torch.linalg.svdvals(centered)[:, 1] / seen.clamp_min(1).sqrt() if len(pixels) else seen.double()
    found: dict[int, str] = {}
    for i in range(len(pixels)):
        if int(seen[i]) < _MINIMUM_CORNERS:
            found[i] = f"it has {int(seen[i])} corners, and at least {_MINIMUM_CORNERS} are needed"
        elif not bool(spread[i]):
            found[i] = "all its corners, or all but one, lie on one line, which leaves the board's pose open"
        elif float(width[i]) < _MINIMUM_WIDTH:
            found[i] = "its corners coincide, or the board is seen edge-on"
    usable = [i for i in range(len(pixels)) if i not in found]
    mirrored = mirrored_views(board_points, pixels[usable]) if usable else torch.zeros(0, dtype=torch.bool)
    if 2 * int(mirrored.sum()) < len(usable):
        why = "it shows the board mirrored: the image is flipped, or its corners are in another order"
        found |= {i: why for i, flipped in zip(usable, mirrored.tolist(), strict=True) if flipped}
    return dict(sorted(found.items()))


def least_planar(board_points: Tensor, pixels: Tensor, names: Sequence[str]) -> str:
    """Which views look least like any flat board, in words: where no lens fits, these are the first to look at.

    Args:
        board_points: (N, 3) meters.
        pixels: (V, N, 2), NaN where not seen.
        names: of the views.

    Example:
        >>> points = torch.cartesian_prod(torch.arange(3.0), torch.arange(3.0), torch.zeros(1)).double()
        >>> mixed = points[[4, 1, 2, 3, 0, 5, 6, 7, 8]]
        >>> views = 100 * torch.stack([points, 2 * points, mixed])[..., :2]
        >>> least_planar(points, views, ["a", "b", "c"])
        'c (its corners are 59 px off a flat board)'
    """
    homography = homographies(board_points, pixels)
    seen = torch.cat([board_points[:, :2], torch.ones_like(board_points[:, :1])], 1) @ homography.mT
    off = (seen[..., :2] / seen[..., 2:] - pixels).square().sum(-1).nanmean(-1).sqrt().nan_to_num(nan=math.inf)
    worst = off.argsort(descending=True)[:_WORST].tolist()
    # A lens bends boards, too, but those of all views.
    typical = float(off.median())
    named = [i for i in worst if float(off[i]) > _BENT * typical] or worst[:1]
    return ", ".join(f"{names[i]} (its corners are {float(off[i]):.0f} px off a flat board)" for i in named)


def check_views(board_points: Tensor, pixels: Tensor, names: Sequence[str], parameters: int, *, fewest: int) -> None:
    """Refuse views that cannot determine a camera, or a view that does not determine its pose.

    Args:
        board_points: (N, 3) meters.
        pixels: (V, N, 2), NaN where not seen.
        names: of the views.
        parameters: how many are estimated beside the poses.
        fewest: number of views that are needed.

    Raises:
        DegenerateError: too few views, poses or corners.
        InputError: a view with too few corners, or with corners on a line or in one place.
    """
    if len(pixels) < fewest:
        raise DegenerateError(
            f"{counted_text(len(pixels), 'view')} of the board: at least {fewest} at different tilts are needed, 10 to "
            "40 are good"
        )
    repeated = repeated_poses(pixels)
    if (poses := len(pixels) - len(repeated)) < fewest:
        pairs = ", ".join(f"{names[i]} like {names[k]}" for i, k in list(repeated.items())[:5])
        raise DegenerateError(
            f"{len(pixels)} views show the board in {counted_text(poses, 'pose')} only, the others are too similar "
            f"({pairs}{', ...' if len(repeated) > 5 else ''}): at least {fewest} at different tilts are needed, 10 to "
            "40 are good; move and tilt the board between views"
        )
    for i, why in unusable_views(board_points, pixels).items():
        raise InputError(f"view {names[i]!r}: {why}; remove the view")
    seen = int(torch.isfinite(pixels).all(-1).sum())
    unknowns = parameters + 6 * len(pixels)
    if 2 * seen <= unknowns:
        raise DegenerateError(
            f"{seen} corners in {len(pixels)} views cannot determine {unknowns} parameters: add views that show more "
            "of the board, or choose a smaller model"
        )


# Find corners and views that noise cannot explain, and solve without them.

# Expected number of good corners beyond the limit in a whole calibration, for normal noise.
_FALSE_CORNERS = 0.01
# The median of |x| of a normal variable is its standard deviation over this.
_MAD = 1.4826
# An outlying view has this many times the typical RMS, and is this many robust standard deviations above it.
_TIMES_TYPICAL, _VIEW_DEVIATIONS = 3.0, 5.0
# Corners are reported if one of them is this many times farther off than noise explains.
_GROSS = 2.0
# A view is left out whole if fewer of its corners are kept, as a number or as a share.
_FEWEST_KEPT, _MINIMUM_KEPT = 6, 0.5
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
    rejected_views: tuple[Rejected, ...]

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
            Rejected(
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
    gone: list[Rejected] = []
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
            gone.append(Rejected(view=names[left[i]], corners=count, residual=float(rms[i]), reason=reason))
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


def stray_corners(residuals: Tensor) -> Tensor:
    """Which corners (V, N) are beyond the limit, if one of them is by twice; none otherwise.

    Smaller deviations are as often the lens model's fault.
    """
    beyond = corners_beyond(residuals)
    return beyond & corners_beyond(residuals, _GROSS).any() if bool(beyond.any()) else beyond


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
        if int(count[i]) < max(_FEWEST_KEPT, _MINIMUM_KEPT * int(had[i])):
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
    kept = tuple(observations.views[i].keeping(good) for i, good in zip(views, (~rejected).tolist(), strict=True))
    return observations.model_copy(update={"views": kept})


def check_share(gone: int, total: int, views: Sequence[Rejected], limit: float) -> None:
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
