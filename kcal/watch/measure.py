"""What the images of one moment tell of the attitude of both cameras, with covariance."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.rig.sources import Features
from kcal.calibrate.rig.turns import camera_turns
from kcal.corners.images import Gray, to_8bit
from kcal.corners.keypoints import keypoints
from kcal.corners.patch_windows import grid_of, has_samples, image_windows, sample
from kcal.corners.shift_fit import fit_shifts
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector
from kcal.lens.rig import StereoRig
from kcal.scene.match import ImagePair, MatchedPair, match_scene
from kcal.scene.still import SAME, SWAY, whole_shifts
from kcal.watch.history import no_look
from kcal.watch.reference import FixedFeatures, with_look
from kcal.watch.state import Look, between_rows

# Steps of a patch from its middle; px that a fit may go, and along the worst axis that it may be unsure.
_HALF, _FARTHEST, _FAINTEST = 7, 1.5, 0.35
_LEAST_SHARE = 0.55
# Pixels that are searched when nearby too little is found: somebody has hit the mast.
_WIDE = 40
# Features without which a camera tells nothing.
FEWEST = 8
# px: light, shade and bilinear samples leave that much in the best patch.
_FLOOR = 0.03
# A lens whose images are larger or smaller by this share, so surely, is another one: 20 K change them by 2e-4.
_OTHER_LENS, _SURELY = 1e-3, 8.0
# Keypoints of an image that shows a scene, whatever scene that is.
_SOME = 150
# Share of the noise of a look that lasts, before it was measured.
_LASTING = 0.33


class Seen(NamedTuple):
    """One camera at one moment.

    Attributes:
        turn: (3,) radians since the reference; zeros if nothing was found.
        covariance: (3, 3).
        found: features that were found and stand still; 0 where they make no turn.
        lasting: share of the covariance that lasts, None if it cannot be told yet.
        reference: with the records of this look.
        note: what is wrong, if anything is.
        lost: an image full of things that are not what was there.
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
    then = torch.where(good[:, None], reference.pixels, math.nan)
    features = Features(
        names=tuple(map(str, range(len(good)))),
        pixels=torch.stack([then, torch.where(good[:, None], now, math.nan)], 1),
        inverse_range=torch.zeros(len(good)).double(),
        inverse_range_sigma=torch.full((len(good),), math.inf).double(),
        # Of both marks: the features together tell how much larger it is.
        pixel_sigma=max(_FLOOR, float(sigma[good].square().mean().sqrt())) / math.sqrt(2.0),
    )
    try:
        (found,), items, _ = camera_turns([camera], [name], features)
    except (InputError, DegenerateError) as error:
        _check_lens(camera, reference.pixels[good], now[good], name)
        return nothing._replace(note=f"{name}: {str(error).removeprefix('drift: ')}", lost=_is_full(image))
    used = torch.tensor([item.used for item in items]) & good
    _check_lens(camera, reference.pixels[used], now[used], name)
    off = torch.where(good[:, None], found.off, 0.0)
    old = used & (reference.looks >= 10)
    lasting = None
    if int(old.sum()) >= FEWEST:
        both = float((off[old] * reference.off[old]).sum()), float(off[old].square().sum())
        lasting = min(0.95, max(0.05, both[0] / both[1]))
    few = f"{name}: only {int(used.sum())} features" if 4 * int(used.sum()) < len(good) else ""
    return Seen(
        found.vector,
        found.covariance + reference.variance,
        int(used.sum()),
        lasting,
        with_look(reference, good, off),
        few,
    )


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
    middle = torch.tensor(camera.size, dtype=torch.float64) / 2.0
    along = then - middle
    zero, one = torch.zeros_like(along[:, 0]), torch.ones_like(along[:, 0])
    # Shift, scale and turn in the image.
    rows = torch.stack([torch.stack([one, zero, along[:, 0], -along[:, 1]], -1),
                        torch.stack([zero, one, along[:, 1], along[:, 0]], -1)], 1)  # fmt: skip
    off, weight = now - then, torch.ones_like(one)
    for _ in range(10):
        normal = torch.einsum("n,nik,nil->kl", weight, rows, rows)
        found = torch.linalg.solve(normal, torch.einsum("n,nik,ni->k", weight, rows, off))
        rest = (off - rows @ found).square().sum(-1)
        scale = rest.median().clamp_min(1e-6)
        weight = 1.0 / (1.0 + rest / (3.0 * scale))
    sigma = math.sqrt(float(scale) * float(torch.linalg.inv(normal)[2, 2]))
    larger = float(found[2])
    if abs(larger) > max(_OTHER_LENS, _SURELY * sigma):
        word = "larger" if larger > 0 else "smaller"
        raise AnotherCameraError(
            f"{name}: images are {100 * abs(larger):.2f} % {word} than the lens of the "
            "rig makes them: another camera, lens, zoom or focus; calibrate it, solve the rig and begin a new history"
        )


@torch.no_grad()
def between_turn(rig: StereoRig, matched: MatchedPair) -> tuple[Tensor, Tensor]:
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
    back = torch.linalg.pinv(between_rows(rig))
    shift = rig.right_from_left_translation / rig.baseline

    def off_plane(values: Tensor) -> tuple[Tensor, Tensor]:
        turns = back @ values
        turn = rotation_from_vector(turns[3:])
        rotation = turn @ rig.right_from_left_rotation @ rotation_from_vector(-turns[:3])
        normal = torch.linalg.cross((turn @ shift).expand_as(left), left @ rotation.T)
        by_pixel = torch.einsum("nk,nkp->np", normal, slope)
        return (normal * right).sum(-1), torch.einsum("np,npq,nq->n", by_pixel, matched.covariance, by_pixel).sqrt()

    values = torch.zeros(5, dtype=torch.float64)
    for _ in range(15):
        off, sigma = off_plane(values)
        steps = 1e-6 * torch.eye(5, dtype=torch.float64)
        rows = torch.stack([(off_plane(values + s)[0] - off_plane(values - s)[0]) / 2e-6 for s in steps], -1)
        rows, scaled = rows / sigma[:, None], off / sigma
        weight = 1.0 / (1.0 + scaled.square() / 9.0).square()
        normal = (weight[:, None] * rows).T @ rows
        move = torch.linalg.solve(normal, (weight[:, None] * rows).T @ scaled)
        values = values - move
        if float(move.norm()) < 1e-10:
            break
    variance = float((weight * scaled.square()).sum() / weight.sum())
    return values, max(1.0, variance) * torch.linalg.inv(normal)


class TwoViews(NamedTuple):
    """A look, both cameras, and the number of matches between them."""

    look: Look
    sides: tuple[Seen, Seen]
    matches: int
    note: str


@torch.no_grad()
def measured(
    rig: StereoRig,
    references: tuple[FixedFeatures, FixedFeatures],
    images: tuple[Gray, Gray],
    turns: Tensor,
    *,
    between: bool,
) -> TwoViews:
    """Look at both images of a moment.

    Args:
        rig: as it was solved.
        references: of both cameras.
        images: left and right.
        turns: (6,) radians, about as the cameras stand.
        between: match the images with each other, too, which takes seconds.

    Raises:
        InputError: another camera or lens.
    """
    sides = [
        seen_by(camera, reference, image, turns[3 * k : 3 * k + 3], name)
        for k, (camera, reference, image, name) in enumerate(
            zip((rig.left, rig.right), references, images, ("left", "right"), strict=True)
        )
    ]
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
