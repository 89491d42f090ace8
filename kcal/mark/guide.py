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
from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector
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
    """A rig and what it may be instead: one rig for each row of its covariance's root, as a batch of cameras.

    Args:
        rig: with or without covariance.
    """

    def __init__(self, rig: StereoRig) -> None:
        left, right = (camera.values.detach() for camera in (rig.left, rig.right))
        half = left.new_zeros(0, len(left) + len(right) + 6) if rig.covariance is None else rig.covariance.half
        moves = torch.cat([half.new_zeros(1, half.shape[1]), half])
        ends = [len(left), len(left) + len(right)]
        with torch.no_grad():
            self._cameras = [
                Camera(values + move, size=camera.size, model=camera.model)
                for values, move, camera in (
                    (left, moves[:, : ends[0]], rig.left),
                    (right, moves[:, ends[0] : ends[1]], rig.right),
                )
            ]
            self._rotation = rotation_from_vector(moves[:, -6:-3]) @ rig.right_from_left_rotation
            self._translation = rig.right_from_left_translation + moves[:, -3:]
        self._nearest = _NEAREST_BASELINES * float(rig.baseline)

    @torch.no_grad()
    def curve(self, side: Side, u: float, v: float) -> Curve:
        """The curve in the other image of a pixel of one side.

        Raises:
            InputError: the lens has no ray there, or nothing on the curve can be seen.
        """
        first, second = self._cameras if side == "left" else self._cameras[::-1]
        rotation, translation = self._rotation, self._translation
        if side == "right":
            rotation = rotation.mT
            translation = -(rotation @ translation[..., None])[..., 0]
        pixel = torch.tensor([[[u, v]]], dtype=torch.float64).expand(len(rotation), 1, 2)
        rays, valid = first.unproject(pixel)
        if not bool(valid[0]):
            raise InputError(_REFUSALS[MatchStatus.NO_RAY])
        near = torch.linspace(0.0, 1.0 / self._nearest, _POINTS, dtype=torch.float64)[:, None]
        points = rays @ rotation.mT + near * ((first.ray_origins(rays) @ rotation.mT) + translation[:, None])
        pixels, seen = second.project(points)
        width, height = second.size
        room = 0.25 * max(width, height)
        inside = ((pixels[0] > -room) & (pixels[0] < torch.tensor([width + room, height + room]))).all(-1)
        kept = seen[0] & inside
        if int(kept.sum()) < 2:
            raise InputError(_REFUSALS[MatchStatus.OUTSIDE])
        # Where a varied lens has no point, it says nothing.
        moved = torch.where(seen[1:, :, None], pixels[1:] - pixels[0], 0.0)[:, kept]
        line = pixels[0, kept]
        along = torch.nn.functional.normalize(torch.gradient(line, dim=0)[0], dim=-1)
        across = torch.stack([-along[:, 1], along[:, 0]], -1)
        return Curve(line, (moved * across).sum(-1).square().sum(0).sqrt())


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
