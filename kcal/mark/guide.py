"""Help with marking: tiles of images, the second mark along the epipolar curve, and points of an earlier session."""

from __future__ import annotations

import functools
import itertools
import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from kcal.calibrate.rig.pairs import image_pairs
from kcal.corners.images import Gray, decode_image, image_bytes, is_video, read_gray
from kcal.corners.match import MatchOptions, MatchStatus, find_again, match_points
from kcal.corners.video import VideoFrames
from kcal.errors import InputError
from kcal.lens.pose import side_axes, step_rows
from kcal.lens.projection import FAR, project_components
from kcal.lens.rig import Rig
from kcal.locate.marks import Marks, read_marks
from kcal.mark.items import Side
from kcal.mark.shapes import snap, three_of

# Help with the second mark: the epipolar curve with its band, and the match on it with covariance or a refusal.

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

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        # The curve's end at infinity is as far away as matters to an entrance pupil that moves.
        nearest = _NEAREST_BASELINES * float(rig.baseline)
        self._inverse = torch.linspace(0.0, 1.0 / nearest, _POINTS, dtype=torch.float64).clamp_min(1.0 / FAR)

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


def _moved_curve(rig: Rig, points: Tensor, of_left: bool) -> Tensor:
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


def propose(rig: Rig, images: tuple[Gray, Gray], side: Side, u: float, v: float, band_sigma: float = 0.0) -> Proposal:
    """Match a pixel of one side in the other image, and back again: a match that does not lead back is refused.

    Args:
        rig: the rig.
        images: (H, W) of the left and the right camera.
        side: where the pixel is.
        u: its column.
        v: its row.
        band_sigma: of the rig across the epipolar line, px; a match may be three of it beside the line.
    """
    back = Rig.pair(rig.right, rig.left, rig.right_from_left_rotation.T,
                     -rig.right_from_left_rotation.T @ rig.right_from_left_translation)  # fmt: skip
    there, return_way = (rig, back) if side == "left" else (back, rig)
    first, second = (torch.from_numpy(np.ascontiguousarray(image)) for image in images[:: 1 if side == "left" else -1])
    off_line = min(max(1.0, 3.0 * band_sigma), 5.0)
    options = MatchOptions(max_off_line=off_line, nearest=_NEAREST_BASELINES * float(rig.baseline))
    start = torch.tensor([[u, v]], dtype=torch.float64)
    try:
        found = match_points(there, first, second, start, options)
        status = MatchStatus(int(found.status[0]))
        if status != MatchStatus.GOOD:
            return Proposal(_REFUSALS[status], score=float(found.score[0]))
        again = match_points(return_way, second, first, found.pixels, options)
    except InputError as error:
        return Proposal(str(error))
    covariance, (at_u, at_v) = found.covariance[0], found.pixels[0].tolist()
    proposal = Proposal("", at_u, at_v, three_of(covariance), float(found.score[0]), float(found.off_line[0]))
    if (status := MatchStatus(int(again.status[0]))) != MatchStatus.GOOD:
        return proposal._replace(refusal=f"{_REFUSALS[status]} (on the way back)")
    miss = float(torch.linalg.vector_norm(again.pixels[0] - start[0]))
    limit = _BACK_PX + _BACK_SIGMAS * math.sqrt(float(covariance.diagonal().max()))
    if miss > limit:
        return proposal._replace(refusal=f"no match: the way back ends {miss:.1f} px away; is it hidden there?")
    return proposal


def at_shape(found: Proposal, image: Gray, how: str) -> Proposal:
    """A match moved to the shape that is there, if that is the shape of the mark it was matched to.

    What stands behind an item is displaced against it between the images, and pulls at a match by its contrast. The
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


# Images of both cameras, frame by frame, as tiles at every scale: what is not looked at is not prepared.

TILE = 512  # pixels along a side of a tile
_KEPT_FRAMES = 2  # per camera: in color, one of 24 megapixels takes 130 MB


class FrameSource(Protocol):
    """Frames by number: gray (H, W), which is measured, and as stored, which is shown."""

    def __getitem__(self, number: int) -> Gray: ...

    def stored(self, number: int) -> Gray:
        """As decoded: gray (H, W), or (H, W, 3) and more in color."""


class _Files:
    def __init__(self, paths: tuple[Path, ...]) -> None:
        self._paths = paths

    def __getitem__(self, number: int) -> Gray:
        return read_gray(self._paths[number])

    def stored(self, number: int) -> Gray:
        return decode_image(image_bytes(self._paths[number]), self._paths[number])


class Pyramid:
    """An image at halved sizes, each made when it is first asked for.

    Args:
        image: (H, W), which is measured.
        stored: gives it as it is shown: (H, W), or (H, W, 3) and more in color; the image itself if not given.
    """

    def __init__(self, image: Gray, stored: Callable[[], Gray] | None = None) -> None:
        self.image = np.ascontiguousarray(image)
        self._stored = stored
        self._levels: list[Gray] = []
        self._lock = threading.Lock()
        low, high = (float(v) for v in np.percentile(image[::16, ::16] if image.size > 1 << 20 else image, (0.1, 99.9)))
        self.span = (low, high if high > low else low + 1.0)

    def level(self, number: int) -> Gray:
        """What is shown, each pixel the mean of 2^number x 2^number; incomplete blocks at the end are left out."""
        with self._lock:
            if not self._levels:
                colors = self.image if self._stored is None else self._stored()[..., :3]
                self._levels.append(self.image if _is_gray(colors) else np.ascontiguousarray(colors))
            while len(self._levels) <= number:
                self._levels.append(_halved(self._levels[-1]))
            return self._levels[number]

    def tile(self, number: int, column: int, row: int, span: tuple[float, float] | None = None) -> NDArray[np.uint8]:
        """A tile (H, W) or (H, W, 3) as 8 bits: the levels themselves, or `span` stretched to 0 to 255.

        Raises:
            InputError: no such tile.
        """
        places = zip((row, column), self.image.shape, strict=True)
        known = 0 <= number <= top_level(self.image.shape)
        if not (known and all(0 <= TILE * at < size >> number for at, size in places)):
            raise InputError(f"no tile {column}, {row} at level {number}")
        part = self.level(number)[row * TILE : (row + 1) * TILE, column * TILE : (column + 1) * TILE]
        if part.dtype == np.uint8 and span is None:
            return part.astype(np.uint8, copy=False)
        low, high = span or self.span
        scaled = (part.astype(np.float32) - low) * (255.0 / max(high - low, 1e-6))
        return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)


def top_level(shape: tuple[int, ...]) -> int:
    """The level at which the image fits one tile."""
    return next(level for level in itertools.count() if max(shape) >> level <= TILE)


def _is_gray(image: Gray) -> bool:
    return image.ndim < 3 or image.shape[2] < 3 or bool((image == image[..., :1]).all())


def _halved(image: Gray) -> Gray:
    height, width = (size // 2 * 2 for size in image.shape[:2])
    even = image[:height, :width]
    if image.dtype == np.uint8:
        return np.asarray(Image.fromarray(np.ascontiguousarray(even)).reduce(2))
    wide = even.astype(np.uint32)
    total = wide[::2, ::2] + wide[1::2, ::2] + wide[::2, 1::2] + wide[1::2, 1::2]
    return ((total + 2) >> 2).astype(np.uint16)


class Pictures:
    """The frames of both cameras.

    Args:
        names: of each pair of frames.
        left: frames of the left camera.
        right: frames of the right camera.
        files: names of the files of each pair, for notes.
    """

    def __init__(self, names: Sequence[str], left: FrameSource, right: FrameSource) -> None:
        self.names = tuple(names)
        self._sources = {"left": left, "right": right}
        self._kept: dict[str, OrderedDict[int, Pyramid]] = {"left": OrderedDict(), "right": OrderedDict()}
        self._locks = {"left": threading.Lock(), "right": threading.Lock()}

    def pyramid(self, side: Side, frame: int) -> Pyramid:
        """A frame with its smaller sizes; the last two of each camera are kept.

        Raises:
            InputError: no such frame.
            FileError: it cannot be read.
        """
        if not 0 <= frame < len(self.names):
            raise InputError(f"there is no frame {frame}; the last one is {len(self.names) - 1}")
        with self._locks[side]:
            kept = self._kept[side]
            if frame not in kept:
                source = self._sources[side]
                kept[frame] = Pyramid(source[frame], functools.partial(source.stored, frame))
            kept.move_to_end(frame)
            while len(kept) > _KEPT_FRAMES:
                kept.popitem(last=False)
            return kept[frame]

    def image(self, side: Side, frame: int) -> Gray:
        """A frame as it was read."""
        return self.pyramid(side, frame).image

    def number(self, name: str) -> int | None:
        """The number of the pair with this name."""
        return self.names.index(name) if name in self.names else None


def open_pictures(left: Path, right: Path) -> Pictures:
    """Images, folders or bags, whose images are paired by name, or two videos that are paired by frame.

    Raises:
        FileError: nothing there, or nothing that can be read.
        InputError: a video and an image, videos of different rates, or names that cannot be paired.
    """
    videos = [is_video(path) for path in (left, right)]
    if videos[0] != videos[1]:
        raise InputError(f"{left} and {right}: two images, two folders or two videos are needed")
    if videos[0]:
        first, second = VideoFrames(left), VideoFrames(right)
        if abs(first.rate - second.rate) > 1e-3 * first.rate:
            raise InputError(
                f"the videos have {first.rate:g} and {second.rate:g} frames a second: frames of one number are not of "
                "one moment; convert one of them"
            )
        return Pictures([f"#{n:06d}" for n in range(min(first.count, second.count))], first, second)
    lefts, rights = zip(*image_pairs([left], [right]), strict=True)
    return Pictures([path.stem for path in lefts], _Files(lefts), _Files(rights))


# Find the points of an earlier session again in new images, for the operator to confirm.

_NOT_FOUND = {
    MatchStatus.NO_RAY: "it has no mark there",
    MatchStatus.OUTSIDE: "not found: it was or is too near the image's border",
    MatchStatus.FLAT: "not found: there is no texture around it in the old image",
    MatchStatus.NO_MATCH: "not found: nothing nearby looks like it; is it hidden, or has the camera turned more?",
    MatchStatus.AMBIGUOUS: "not found: several places nearby look alike",
    MatchStatus.NOT_CONVERGED: "not found: the fit did not converge",
}


class Reference:
    """Marks of static items in old images.

    Args:
        marks: their file.
        left: old image of the left camera.
        right: of the right camera.

    Raises:
        FileError: a file that cannot be read.
        InputError: several old images; one pair is needed.
    """

    def __init__(self, marks: Path, left: Path, right: Path) -> None:
        self.marks: Marks = read_marks(marks, single=True)
        self._pictures: Pictures = open_pictures(left, right)
        if len(self._pictures.names) != 1:
            raise InputError("--reference-images: one old pair of images is needed")

    def find(self, name: str, side: Side, image: Gray, reach: int) -> Proposal:
        """Where an item is now, or why it was not found.

        Raises:
            InputError: no such name, or images of unlike sizes.
        """
        if name not in self.marks.names:
            raise InputError(f"nothing is named {name!r} in the reference")
        row = self.marks.names.index(name)
        pixel = (self.marks.left if side == "left" else self.marks.right)[row : row + 1]
        old = self._pictures.image(side, 0)
        found = find_again(torch.from_numpy(old), torch.from_numpy(image), pixel, reach)
        status = MatchStatus(int(found.status[0]))
        score = float(found.score[0])
        if status != MatchStatus.GOOD:
            return Proposal(_NOT_FOUND[status], score=score)
        u, v = found.pixels[0].tolist()
        return Proposal("", u, v, three_of(found.covariance[0]), score)
