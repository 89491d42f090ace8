"""Help with the second mark: the epipolar curve with its band, and the match on it with covariance or a refusal."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.corners.images import Gray
from kcal.corners.match import MatchOptions, MatchStatus, match_points
from kcal.errors import InputError
from kcal.lens.pose import side_axes, step_rows
from kcal.lens.projection import project_components
from kcal.lens.pupil import FAR
from kcal.lens.rig import StereoRig
from kcal.mark.items import Side
from kcal.mark.snap import snap

_NEAREST_BASELINES = 3.0  # of the curve's near end; `MatchOptions.nearest` is 10
_POINTS = 96  # on a curve
_SAME_SHAPE = 1.5  # px from the match to the shape there: a background in motion pulls by less
# px and sigmas: how far from where it began the way back may end. Both matches have noise.
_BACK_PX, _BACK_SIGMAS = 0.5, 4.0

_REFUSALS = {
    MatchStatus.NO_RAY: "the lens model has no ray here",
    MatchStatus.OUTSIDE: "no match: it is outside the other image, or too near a border",
    MatchStatus.FLAT: "no match: flat, there is no texture around it",
    MatchStatus.NO_MATCH: "no match: nothing on the epipolar line looks like it; is it hidden, or has the rig turned?",
    MatchStatus.AMBIGUOUS: "no match: repeated texture, several places on the epipolar line look alike",
    MatchStatus.NOT_CONVERGED: "no match: the fit did not converge",
    MatchStatus.OFF_LINE: "no match: what looks like it is off the epipolar line; has the rig turned?",
}


class Curve(NamedTuple):
    """An epipolar curve in the other image, from infinity to near.

    Attributes:
        pixels: (M, 2) inside or near the image.
        sigma: (M,) px across the curve, from errors of the rig; zeros if nothing is known of them.
    """

    pixels: Tensor
    sigma: Tensor


class Proposal(NamedTuple):
    """A matched mark, or why there is none.

    Attributes:
        refusal: empty if there is a match.
        u: column.
        v: row.
        cov: variance of u, covariance, variance of v, px², of the match alone.
        score: normalized correlation, NaN if none was computed.
        off_line: px from the epipolar line, NaN if there is no match.
        how: "match", or the shape whose place was then taken: its error is its own.
    """

    refusal: str
    u: float = math.nan
    v: float = math.nan
    cov: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    score: float = math.nan
    off_line: float = math.nan
    how: str = "match"


class RigBand:
    """A rig, and how its errors move epipolar curves: to first order, from one joint covariance.

    Args:
        rig: with or without covariance.
    """

    def __init__(self, rig: StereoRig) -> None:
        self._rig = rig
        # The curve's end at infinity is as far away as matters to an entrance pupil that moves.
        self._inverse = torch.linspace(
            0.0, 1.0 / (_NEAREST_BASELINES * float(rig.baseline)), _POINTS, dtype=torch.float64
        ).clamp_min(1.0 / FAR)

    @torch.no_grad()
    def curve(self, side: Side, u: float, v: float) -> Curve:
        """The curve in the other image of a pixel of one side.

        Raises:
            InputError: the lens has no ray there, or nothing on the curve can be seen.
        """
        rig, of_left = self._rig, side == "left"
        first, second = (rig.left, rig.right) if of_left else (rig.right, rig.left)
        rays, valid = first.unproject(torch.tensor([[u, v]], dtype=torch.float64))
        if not bool(valid[0]):
            raise InputError(_REFUSALS[MatchStatus.NO_RAY])
        points = first.ray_origins(rays) + rays / self._inverse[:, None]
        if not of_left:
            points = (points - rig.right_from_left_translation) @ rig.right_from_left_rotation
        pixels, seen = second.project(rig.right_from_left(points) if of_left else points)
        width, height = second.size
        room = 0.25 * max(width, height)
        kept = seen & ((pixels > -room) & (pixels < torch.tensor([width + room, height + room]))).all(-1)
        if int(kept.sum()) < 2:
            raise InputError(_REFUSALS[MatchStatus.OUTSIDE])
        line = pixels[kept]
        along = torch.nn.functional.normalize(torch.gradient(line, dim=0)[0], dim=-1)
        across = torch.stack([-along[:, 1], along[:, 0]])
        moved = _moved_curve(rig, points[kept].T, of_left)
        return Curve(line, (moved * across).sum(-2).square().sum(0).sqrt())


def _moved_curve(rig: StereoRig, points: Tensor, of_left: bool) -> Tensor:
    """(K, 2, M) by how much each of K independent errors of a rig moves an epipolar curve.

    Points of the curve go aside so that the pixel that they belong to stays, and are seen elsewhere in the other image.

    Args:
        rig: with or without covariance.
        points: (3, M) of the curve, in the rig frame.
        of_left: the pixel is one of the left image.
    """
    if rig.covariance is None:
        return points.new_zeros(0, 2, points.shape[1])
    rotated = rig.right_from_left_rotation @ points
    seen = [
        project_components(at, camera.values, camera.model, range(camera.values.shape[-1]))
        for camera, at in ((rig.left, points), (rig.right, rotated + rig.right_from_left_translation[:, None]))
    ]
    by_rig = seen[0].by_camera, torch.cat([seen[1].by_camera, step_rows(seen[1].by_point, rotated)])
    ends = len(by_rig[0])
    moved = [
        torch.einsum("kp,pum->kum", half, rows)
        for half, rows in zip(rig.covariance.half.tensor_split([ends], 1), by_rig, strict=True)
    ]
    # Two ways aside, as long as the point is far, so that the derivatives are those of directions.
    far = points.norm(dim=0)
    aside = torch.stack([far * axis.T for axis in side_axes((points / far).T)])
    by_aside = [
        torch.einsum("xum,dxm->mud", each.by_point, way)
        for each, way in zip(seen, (aside, rig.right_from_left_rotation @ aside), strict=True)
    ]
    own, other = (0, 1) if of_left else (1, 0)
    undone = torch.linalg.solve(by_aside[own], moved[own].permute(2, 1, 0))
    return moved[other] - (by_aside[other] @ undone).permute(2, 1, 0)


def propose(
    rig: StereoRig, images: tuple[Gray, Gray], side: Side, u: float, v: float, band_sigma: float = 0.0
) -> Proposal:
    """Match a pixel of one side in the other image, and back again: a match that does not lead back is refused.

    Args:
        rig: the rig.
        images: (H, W) of the left and the right camera.
        side: where the pixel is.
        u: its column.
        v: its row.
        band_sigma: of the rig across the epipolar line, px; a match may be three of it beside the line.
    """
    back = StereoRig(rig.right, rig.left, rig.right_from_left_rotation.T,
                     -rig.right_from_left_rotation.T @ rig.right_from_left_translation)  # fmt: skip
    there, return_way = (rig, back) if side == "left" else (back, rig)
    first, second = (torch.from_numpy(np.ascontiguousarray(image)) for image in images[:: 1 if side == "left" else -1])
    options = MatchOptions(
        max_off_line=min(max(1.0, 3.0 * band_sigma), 5.0), nearest=_NEAREST_BASELINES * float(rig.baseline)
    )
    start = torch.tensor([[u, v]], dtype=torch.float64)
    try:
        found = match_points(there, first, second, start, options)
        status = MatchStatus(int(found.status[0]))
        if status != MatchStatus.GOOD:
            return Proposal(_REFUSALS[status], score=float(found.score[0]))
        again = match_points(return_way, second, first, found.pixels, options)
    except InputError as error:
        return Proposal(str(error))
    covariance = found.covariance[0]
    at_u, at_v = found.pixels[0].tolist()
    cov = (float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1]))
    proposal = Proposal("", at_u, at_v, cov, float(found.score[0]), float(found.off_line[0]))
    if int(again.status[0]) != MatchStatus.GOOD:
        status = MatchStatus(int(again.status[0]))
        return proposal._replace(refusal=f"{_REFUSALS[status]} (on the way back)")
    miss = float(torch.linalg.vector_norm(again.pixels[0] - start[0]))
    limit = _BACK_PX + _BACK_SIGMAS * math.sqrt(float(covariance.diagonal().max()))
    if miss > limit:
        return proposal._replace(refusal=f"no match: the way back ends {miss:.1f} px away; is it hidden there?")
    return proposal


def at_shape(found: Proposal, image: Gray, how: str) -> Proposal:
    """A match moved to the shape that is there, if that is the shape of the mark it was matched to.

    What stands behind a thing is displaced against it between the images, and pulls at a match by its contrast. The
    shape's own edges are free of that.

    Args:
        found: the match.
        image: (H, W) in which it was found.
        how: the shape of the mark.
    """
    if found.refusal:
        return found
    try:
        there = snap(image, found.u, found.v)
    except InputError:
        return found
    far = math.hypot(there.u - found.u, there.v - found.v)
    if there.how != how or far > _SAME_SHAPE:
        return found
    return found._replace(u=there.u, v=there.v, cov=there.cov, how=how)
