"""What is looked for in each image of a watched rig: patches of fixed things, and where they were.

Things that move, and patches that have changed, are learned out by time. When half of them are gone, new ones are added
where the present attitude puts them; how well that was known is kept.
"""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from kcal.corners.images import Gray, to_8bit
from kcal.corners.keypoints import keypoints
from kcal.errors import FileError, InputError
from kcal.files import read_bytes, write_atomic
from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector
from kcal.lens.rig import StereoRig
from kcal.strict_npz import read_npz

# Pixels of a patch to each side: what least-squares matching reads of it.
REACH = 15
# Features of a camera, cells across and down among which they are spread, and pixels between them.
_MOST, _CELLS, _APART = 400, (16, 9), 12.0
# Below that many features a reference is of no use.
_FEWEST = 20
# Looks of which a feature's record is a mean; before so many it is not judged.
MEMORY = 30
# Learned out: found in fewer than this share of the looks that found others, or so many pixels off in the mean.
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
        own = {name: getattr(self, name)[which] for name in _FIELDS[:-1]}
        return dataclasses.replace(self, **own)


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
    """The reference after a look.

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
    return dataclasses.replace(
        reference, looks=looks, found=found, off=reference.off + torch.where(seen[:, None], own, 0.0)
    )


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


def save_references(path: str | Path, rig: StereoRig, sides: tuple[FixedFeatures, FixedFeatures]) -> Path:
    """Write the references of both cameras to an .npz file."""
    arrays = {
        f"{word}_{name}": getattr(side, name).numpy()
        for word, side in zip(("left", "right"), sides, strict=True) for name in _FIELDS
    }  # fmt: skip
    buffer = io.BytesIO()
    np.savez_compressed(buffer, rig=np.array(rig.fingerprint), **arrays)
    return write_atomic(path, buffer.getvalue())


def load_references(path: str | Path, rig: StereoRig) -> tuple[FixedFeatures, FixedFeatures]:
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
