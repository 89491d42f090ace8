"""What is looked for in the images of a watched rig, and what they tell of the attitude of both cameras."""

from __future__ import annotations

import dataclasses
import io
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.corners.images import Gray, to_8bit
from kcal.corners.match import keypoints
from kcal.corners.patches import fit_shifts, grid_of, has_samples, image_windows, sample
from kcal.errors import DegenerateError, FileError, InputError
from kcal.files import read_bytes, write_atomic
from kcal.lens.camera import Camera
from kcal.lens.pose import fit_turn, rotation_from_vector, seen_turned, vector_from_rotation
from kcal.lens.projection import FAR
from kcal.lens.rig import Rig
from kcal.scene.match import ImagePair, MatchedPair, match_scene
from kcal.scene.refine import SAME, SWAY, whole_shifts
from kcal.strict_formats import read_npz
from kcal.watch.history import Look, between_rows, no_look
from kcal.watch.marked_twice import camera_turns

# What is looked for in each image of a watched rig: patches of fixed points, and where they were.
#
# Features that move, and patches that have changed, are dropped in time. When half of the features are gone, new ones
# are added where the present attitude puts them; the covariance of that attitude is kept with them.

# Pixels from the middle of a stored patch to its sides, as many as least-squares matching needs.
REACH = 15
# Features of a camera, cells across and down among which they are spread, and pixels between them.
_MOST, _CELLS, _APART = 400, (16, 9), 12.0
# Fewest features of a reference.
_FEWEST = 20
# Number of measurements over which the record of a feature is averaged; a feature with fewer is not judged.
MEMORY = 30
# A feature is dropped if fewer than this share of the measurements found it, or if it is so many pixels off on average.
_SELDOM, _OFF = 0.3, 0.5
_LARGEST = 2**26
_FIELDS = ("pixels", "middle", "patches", "looks", "found", "off", "variance")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class FixedFeatures:
    """Features of one camera, F of them.

    Args:
        pixels: (F, 2) where they were when the camera stood as the rig says.
        middle: (F, 2) where they are in their patches.
        patches: (F, 31, 31) uint8.
        looks: (F,) at which others were found.
        found: (F,) share of these at which it was found.
        off: (F, 2) px, mean of where it is beside the turn of the camera.
        variance: (3, 3) radians² by which the reference may have turned, since features were added.
    """

    pixels: Tensor
    middle: Tensor
    patches: Tensor
    looks: Tensor
    found: Tensor
    off: Tensor
    variance: Tensor

    @property
    def mosaic(self) -> tuple[Tensor, Tensor]:
        """All patches as one image (31 F, 31) float32, and (F, 2) where the features are in it."""
        side = 2 * REACH + 1
        down = side * torch.arange(len(self.middle)).double()
        return self.patches.reshape(-1, side).float(), self.middle + torch.stack([torch.zeros_like(down), down], -1)

    def at(self, which: Tensor) -> FixedFeatures:
        """Some of the features."""
        return dataclasses.replace(self, **{name: getattr(self, name)[which] for name in _FIELDS[:-1]})


def new_reference(image: Gray, name: str) -> FixedFeatures:
    """The features of an image.

    Raises:
        InputError: it has too few.
    """
    made = _spread_features(image, torch.zeros(0, 2, dtype=torch.float64), _MOST)
    if len(made.pixels) < _FEWEST:
        raise InputError(
            f"{name}: {len(made.pixels)} features; a reference needs {_FEWEST}: begin by daylight, with a clean lens, "
            "and more of the land in the image"
        )
    return made


def _spread_features(image: Gray, taken: Tensor, most: int) -> FixedFeatures:
    """Up to `most` strong keypoints, spread over the image, not near those that are taken."""
    gray = to_8bit(image)
    height, width = gray.shape
    pixels = keypoints(image, 20 * _MOST).pixels
    size = torch.tensor([width, height], dtype=torch.float64)
    inside = ((pixels.round() >= REACH) & (pixels.round() <= size - 1 - REACH)).all(-1)
    pixels = pixels[inside]
    cell = (pixels / size * torch.tensor(_CELLS)).long()
    number, kept, counts = cell[:, 1] * _CELLS[0] + cell[:, 0], list[int](), dict[int, int]()
    places, limit = taken, -(-2 * _MOST // (_CELLS[0] * _CELLS[1]))
    for i, place in enumerate(number.tolist()):
        if len(kept) == most:
            break
        near = len(places) and float((places - pixels[i]).square().sum(-1).min()) < _APART**2
        if counts.get(place, 0) >= limit or near:
            continue
        counts[place] = counts.get(place, 0) + 1
        kept.append(i)
        places = torch.cat([places, pixels[i : i + 1]])
    pixels = pixels[kept]
    whole = torch.from_numpy(np.ascontiguousarray(gray))
    corners = pixels.round().long().tolist()
    patches = [whole[y - REACH : y + REACH + 1, x - REACH : x + REACH + 1] for x, y in corners]
    side, count = 2 * REACH + 1, len(pixels)
    return FixedFeatures(
        pixels=pixels, middle=pixels - pixels.round() + REACH,
        patches=torch.stack(patches) if patches else torch.zeros(0, side, side, dtype=torch.uint8),
        looks=torch.zeros(count, dtype=torch.float64), found=torch.ones(count, dtype=torch.float64),
        off=torch.zeros(count, 2, dtype=torch.float64), variance=torch.zeros(3, 3, dtype=torch.float64),
    )  # fmt: skip


def with_look(reference: FixedFeatures, seen: Tensor, off: Tensor) -> FixedFeatures:
    """The reference after a measurement.

    Args:
        reference: before it.
        seen: (F,) which were found.
        off: (F, 2) px beside the turn of the camera; not read where it was not found.
    """
    looks = reference.looks + 1.0
    weight = 1.0 / looks.clamp_max(MEMORY)
    found = reference.found + weight * (seen.double() - reference.found)
    # The mean of those looks at which it was found.
    own = (weight / found.clamp_min(weight))[:, None] * (off - reference.off)
    off = reference.off + torch.where(seen[:, None], own, 0.0)
    return dataclasses.replace(reference, looks=looks, found=found, off=off)


def renewed(reference: FixedFeatures, camera: Camera, image: Gray, turn: Tensor, covariance: Tensor) -> FixedFeatures:
    """Without what moves or has changed; with new features where half of them are gone.

    Args:
        reference: of the camera.
        camera: that took the image.
        image: of now.
        turn: (3,) radians since the reference.
        covariance: (3, 3) of it.
    """
    old = reference.looks >= MEMORY
    gone = old & ((reference.found < _SELDOM) | (reference.off.norm(dim=-1) > _OFF))
    kept = reference.at(~gone) if bool(gone.any()) else reference
    if len(kept.pixels) >= _MOST // 2 or not bool(old.any()):
        return kept
    rays, _ = camera.unproject(kept.pixels)
    more = _spread_features(image, camera.project(rays @ rotation_from_vector(turn).T)[0], _MOST - len(kept.pixels))
    if not len(more.pixels):
        return kept
    rays, valid = camera.unproject(more.pixels)
    back, there = camera.project(rays @ rotation_from_vector(turn))
    more = dataclasses.replace(more, pixels=back).at(valid & there)
    share = len(more.pixels) / (len(more.pixels) + len(kept.pixels))
    both = {name: torch.cat([getattr(kept, name), getattr(more, name)]) for name in _FIELDS[:-1]}
    return FixedFeatures(**both, variance=kept.variance + share**2 * covariance)


def save_references(path: str | Path, rig: Rig, sides: tuple[FixedFeatures, FixedFeatures]) -> Path:
    """Write the references of both cameras to an .npz file."""
    arrays = {
        f"{word}_{name}": getattr(side, name).numpy()
        for word, side in zip(("left", "right"), sides, strict=True) for name in _FIELDS
    }  # fmt: skip
    buffer = io.BytesIO()
    np.savez_compressed(buffer, rig=np.array(rig.fingerprint), **arrays)
    return write_atomic(path, buffer.getvalue())


def load_references(path: str | Path, rig: Rig) -> tuple[FixedFeatures, FixedFeatures]:
    """Read what `save_references` wrote.

    Raises:
        FileError: no such file, a damaged one, or one of another rig.
    """
    arrays = read_npz(read_bytes(path), str(path), _LARGEST, "reference of a watched rig")
    try:
        named = str(arrays["rig"])
        if named != rig.fingerprint:
            raise FileError(
                f"{path}: the reference is of another rig ({named}, not {rig.fingerprint}): were cameras replaced or "
                "the rig solved again? Begin a new history"
            )
        sides = [FixedFeatures(**{name: torch.from_numpy(arrays[f"{word}_{name}"]) for name in _FIELDS})
                 for word in ("left", "right")]  # fmt: skip
        for side in sides:
            count, wide = len(side.pixels), 2 * REACH + 1
            shapes = [(count, 2), (count, 2), (count, wide, wide), (count,), (count,), (count, 2), (3, 3)]
            for name, shape in zip(_FIELDS, shapes, strict=True):
                value = getattr(side, name)
                if tuple(value.shape) != shape or not bool(torch.isfinite(value.double()).all()):
                    raise ValueError(f"{name}: shape {tuple(value.shape)}")
    except (KeyError, ValueError, TypeError) as error:
        raise FileError(f"{path}: a damaged reference ({error}); remove it to begin anew") from error
    return sides[0], sides[1]


# What the images of one time tell of the attitude of both cameras, with covariance.

# Steps of a patch from its middle; px that a fit may go, and along the worst axis that it may be unsure.
_HALF, _FARTHEST, _FAINTEST = 7, 1.5, 0.35
_LEAST_SHARE = 0.55
# Pixels that are searched where too few features are found nearby, as after somebody has hit the mast.
_WIDE = 40
# Fewest features from which the turn of a camera is computed.
FEWEST = 8
# px: smallest standard deviation of a patch, which light, shade and bilinear interpolation leave.
_FLOOR = 0.03
# Images that are larger or smaller by this share, and by so many sigmas, are of another lens: 20 K change them by 2e-4.
_OTHER_LENS, _SURELY = 1e-3, 8.0
# Keypoints of an image that shows a scene, whatever scene that is.
_SOME = 150
# Share of the noise of a measurement that is assumed to last until it is measured.
_LASTING = 0.33


class Seen(NamedTuple):
    """One camera at one time.

    Attributes:
        turn: (3,) radians since the reference; zeros if nothing was found.
        covariance: (3, 3).
        found: number of features that were found and stand still; 0 where no turn could be computed.
        lasting: share of the covariance that lasts; None where it is not known yet.
        reference: with the records of this measurement.
        note: what is wrong, if anything is.
        lost: whether the image shows a scene, but nothing of the reference.
    """

    turn: Tensor
    covariance: Tensor
    found: int
    lasting: float | None
    reference: FixedFeatures
    note: str = ""
    lost: bool = False


class AnotherCameraError(InputError):
    """An image that no turn of the camera explains, and that another lens does."""


def seen_by(camera: Camera, reference: FixedFeatures, image: Gray, turn: Tensor, name: str) -> Seen:
    """Find the features of a reference in an image, and how the camera has turned since.

    Args:
        camera: of the rig.
        reference: of this camera.
        image: of now.
        turn: (3,) radians, about as it stands.
        name: of the camera, in messages.

    Raises:
        InputError: an image of another size, or a camera with another lens (`AnotherCameraError`).
    """
    if image.shape[::-1] != tuple(camera.size):
        raise AnotherCameraError(
            f"the {name} image has {image.shape[1]}x{image.shape[0]} pixels, its camera {camera.size[0]}x"
            f"{camera.size[1]}: was the camera replaced?"
        )
    gray = torch.from_numpy(to_8bit(image).astype(np.float32))
    now, sigma, good = _patches_again(camera, reference, gray, turn, SWAY)
    if int(good.sum()) < FEWEST:
        wide = _patches_again(camera, reference, gray, turn, _WIDE)
        if int(wide[2].sum()) > 2 * int(good.sum()):
            now, sigma, good = wide
    count = int(good.sum())
    nothing = Seen(torch.zeros(3).double(), torch.eye(3).double(), 0, None, reference)
    if count < FEWEST:
        full = _is_full(image)
        why = "nothing of the reference is there" if full else "dark, fog, or a dirty lens?"
        return nothing._replace(note=f"{name}: {count} features ({why})", lost=full)
    then, now = (torch.where(good[:, None], marks, math.nan) for marks in (reference.pixels, now))
    # Of both marks: the features together tell how much larger it is.
    pair_sigma = max(_FLOOR, float(sigma[good].square().mean().sqrt()))
    try:
        turns = camera_turns([camera], [name], then[:, None], now[:, None], pair_sigma)
    except (InputError, DegenerateError) as error:
        _check_lens(camera, reference.pixels[good], now[good], name)
        return nothing._replace(note=f"{name}: {str(error).removeprefix('drift: ')}", lost=_is_full(image))
    (found,), used = turns.each, turns.used
    _check_lens(camera, reference.pixels[used], now[used], name)
    off = torch.where(good[:, None], found.off, 0.0)
    old = used & (reference.looks >= 10)
    lasting = None
    if int(old.sum()) >= FEWEST:
        both = float((off[old] * reference.off[old]).sum()), float(off[old].square().sum())
        lasting = min(0.95, max(0.05, both[0] / both[1]))
    few = f"{name}: only {int(used.sum())} features" if 4 * int(used.sum()) < len(good) else ""
    covariance = found.covariance + reference.variance
    return Seen(found.vector, covariance, int(used.sum()), lasting, with_look(reference, good, off), few)


def _is_full(image: Gray) -> bool:
    return len(keypoints(image, 2 * _SOME).pixels) >= _SOME


def _patches_again(
    camera: Camera, reference: FixedFeatures, image: Tensor, turn: Tensor, sway: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels (F, 2) of the features now, their sigma (F,) along the worst axis, and which (F,) were found."""
    mosaic, here = reference.mosaic
    rays, valid = camera.unproject(reference.pixels)
    there, seen = camera.project(rays @ rotation_from_vector(turn).T)
    there = torch.where(seen[:, None], there, reference.pixels)
    moves, score = whole_shifts(mosaic, image, here, there, sway)
    small = grid_of((_HALF, _HALF), image.device)
    first, second = here[:, None, None] + small, (there + moves)[:, None, None] + small
    one, flat = image_windows(mosaic, first, 0, math.inf), second.flatten(1, 2)
    two = image_windows(image, torch.cat([flat - _FARTHEST, flat + _FARTHEST], 1), 0, math.inf)
    weight = (has_samples(one, first) & has_samples(two, second)).double()
    wanted = valid & seen & (score > SAME) & (weight.mean((1, 2)) > 0.99)
    steps = torch.eye(2, dtype=torch.float64).expand(*second.shape, 2)
    fit = fit_shifts(sample(one, first), two, second, steps, weight, wanted)
    sigma = torch.linalg.eigvalsh(fit.covariance.nan_to_num(1.0))[:, -1].clamp_min(0.0).sqrt()
    near = fit.shift.norm(dim=-1) < _FARTHEST
    good = wanted & fit.converged & near & (sigma < _FAINTEST) & (fit.share > _LEAST_SHARE)
    return there + moves + fit.shift, sigma, good


def _check_lens(camera: Camera, then: Tensor, now: Tensor, name: str) -> None:
    """Raise `AnotherCameraError` if images are larger or smaller than they were."""
    rays, middle = camera.unproject(then)[0], torch.tensor(camera.size, dtype=torch.float64) / 2.0

    def weighted(turn: Tensor, larger: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        seen, rows = seen_turned(camera, FAR * rays, turn)
        away = seen.T - middle
        off = away * (1.0 + larger) + middle - now
        square = off.square().sum(-1)
        scale = square.nanmedian().clamp_min(1e-6)
        root = (1.0 / (1.0 + square / (3.0 * scale))).sqrt()[:, None]
        by_all = torch.cat([rows[:3].permute(2, 1, 0), away[..., None]], -1)
        return (root[..., None] * by_all).flatten(0, 1), (root * off).flatten(), scale

    found = fit_turn(torch.eye(3, dtype=torch.float64), lambda *at: weighted(*at)[:2], more=1, steps=10)
    rows, _, scale = weighted(found.rotation, found.more)
    sigma = math.sqrt(float(scale) * float(torch.linalg.inv(rows.T @ rows)[3, 3]))
    larger = float(found.more)
    if abs(larger) > max(_OTHER_LENS, _SURELY * sigma):
        word = "larger" if larger > 0 else "smaller"
        raise AnotherCameraError(
            f"{name}: images are {100 * abs(larger):.2f} % {word} than the lens of the "
            "rig makes them: another camera, lens, zoom or focus; calibrate it, solve the rig and begin a new history"
        )


@torch.no_grad()
def between_turn(rig: Rig, matched: MatchedPair) -> tuple[Tensor, Tensor]:
    """What matches between the cameras tell of their turns since the rig was solved: (5,), (5, 5); see `between_rows`.

    Args:
        rig: as it was solved.
        matched: of unknown ranges.
    """
    left, _ = rig.left.unproject(matched.pixels[:, 0])
    right, _ = rig.right.unproject(matched.pixels[:, 1])
    sides = [rig.right.unproject(matched.pixels[:, 1] + step)[0] for step in 0.5 * torch.eye(2).double()]
    others = [rig.right.unproject(matched.pixels[:, 1] - step)[0] for step in 0.5 * torch.eye(2).double()]
    slope = torch.stack([a - b for a, b in zip(sides, others, strict=True)], -1)
    relative, across = rig.right_from_left_rotation, between_rows(rig)[3:, :3]
    baseline = -relative.T @ rig.right_from_left_translation / rig.baseline
    # Aside from the baseline, in the left camera's frame: `across` are these cross the baseline.
    aside = torch.linalg.cross(across, baseline.expand(2, 3))

    def scaled(turn: Tensor, moved: Tensor) -> tuple[Tensor, Tensor]:
        """By how many sigmas each match is off the plane of the baseline and its left ray, and the derivatives."""
        turned, moved = left @ (turn @ relative).T, turn @ relative @ (baseline + moved @ aside)
        normal = torch.linalg.cross(turned, moved.expand_as(left))
        by_pixel = torch.einsum("nk,nkp->np", normal, slope)
        sigma = torch.einsum("np,npq,nq->n", by_pixel, matched.covariance, by_pixel).sqrt()
        # Both turn: as if the right ray turned back.
        by_turn = torch.linalg.cross(normal, right)
        by_moved = torch.linalg.cross(right, turned) @ (turn @ relative @ aside.T)
        return torch.cat([by_turn, by_moved], 1) / sigma[:, None], (normal * right).sum(-1) / sigma

    def look(turn: Tensor, moved: Tensor) -> tuple[Tensor, Tensor]:
        rows, off = scaled(turn, moved)
        root = 1.0 / (1.0 + off.square() / 9.0)
        return root[:, None] * rows, root * off

    found = fit_turn(torch.eye(3, dtype=torch.float64), look, more=2, steps=15)
    rows, off = scaled(found.rotation, found.more)
    weight = 1.0 / (1.0 + off.square() / 9.0).square()
    variance = float((weight * off.square()).sum() / weight.sum())
    values = torch.cat([vector_from_rotation(found.rotation), found.more])
    return values, max(1.0, variance) * torch.linalg.inv((weight[:, None] * rows).T @ rows)


class TwoViews(NamedTuple):
    """A measurement, both cameras, and the number of matches between them."""

    look: Look
    sides: tuple[Seen, Seen]
    matches: int
    note: str


@torch.no_grad()
def measured(
    rig: Rig,
    references: tuple[FixedFeatures, FixedFeatures],
    images: tuple[Gray, Gray],
    turns: Tensor,
    *,
    between: bool,
) -> TwoViews:
    """Look at both images of a time.

    Args:
        rig: as it was solved.
        references: of both cameras.
        images: left and right.
        turns: (6,) radians, about as the cameras stand.
        between: match the images with each other, too, which takes seconds.

    Raises:
        InputError: another camera or lens.
    """
    each = zip((rig.left, rig.right), references, images, turns.split(3), ("left", "right"), strict=True)
    sides = [seen_by(*one) for one in each]
    told = [side.lasting for side in sides if side.lasting is not None]
    seen = torch.tensor([side.found > 0 for side in sides])
    look = no_look()._replace(
        turn=torch.cat([side.turn for side in sides]),
        covariance=torch.block_diag(*(side.covariance for side in sides)),
        lasting=torch.tensor(sum(told) / len(told) if told else _LASTING, dtype=torch.float64),
        seen=seen,
    )
    notes, matches = [side.note for side in sides if side.note], 0
    if between and bool(seen.all()):
        try:
            matched = match_scene((rig.left, rig.right), ImagePair("between the cameras", *images))
        except InputError as error:
            notes.append(str(error))
        else:
            values, covariance = between_turn(rig, matched)
            matches = len(matched.pixels)
            look = look._replace(between=values, between_covariance=covariance, matched=torch.tensor(True))
    return TwoViews(look, (sides[0], sides[1]), matches, "; ".join(notes))
