"""Whether place and time of night images can be right, from the images themselves.

Not noticed can be: a place or a clock that is wrong by the same for all images that look high up, where refraction says
little of the altitude. Landmarks, positions of both cameras or a compass tell then.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.lens.camera import Camera
from kcal.lens.pose import vector_from_rotation
from kcal.stars.attitude import Attitude, star_rows
from kcal.stars.sky import EARTH_RATE, pole_in_enu

if TYPE_CHECKING:
    from kcal.stars.night import NamedStars

# Standard deviations beyond which chance explains nothing.
_SURE = 5.0
# px: refraction of a wrong altitude must differ by more than a good lens errs.
_LENS = 0.04
# Degrees by which a mast may bend between two images.
_BENDS = 0.02


def refraction_doubt(
    seen: Attitude, sigma: NDArray[np.float64], refracted: Tensor, straight: Tensor, camera: Camera
) -> str | None:
    """Whether stars are refracted as they would be at the place and time that were given; None if they are.

    Args:
        seen: the attitude on the Earth, with its N named stars.
        sigma: (N,) of these, px.
        refracted: (N, 3) directions in which they would be seen there and then.
        straight: (N, 3) likewise without air.
        camera: which lens.
    """
    at, rows = star_rows(refracted, seen.rotation, camera, camera.params.detach())
    without, _ = star_rows(straight, seen.rotation, camera, camera.params.detach())
    weight = torch.from_numpy(1.0 / sigma) / seen.widened
    pattern = (at - without) * weight
    turns = (rows * weight).flatten(1)
    own = pattern.flatten() - turns.T @ torch.linalg.lstsq(turns.T, pattern.flatten()[:, None]).solution[:, 0]
    residual = torch.from_numpy(seen.residual[seen.star >= 0]).T * weight
    length = float(own.norm())
    if length == 0.0:
        return None
    # The residual is projected minus seen: seen refraction is (1 - excess) of what was assumed.
    excess = float(own @ residual.flatten()) / length**2
    moved = abs(excess) * float((own.reshape(2, -1) / weight).square().mean().sqrt())
    if abs(excess) * length < _SURE or moved < _LENS:
        return None
    return (
        f"refraction is {1.0 - excess:.2f} ± {1.0 / length:.2f} times what it would be there and then: the stars stand "
        f"{'lower' if excess < 0 else 'higher'} than place and time say; one of them is wrong, or the lens"
    )


def clock_doubts(images: Sequence[NamedStars]) -> list[tuple[int, str]]:
    """Images whose camera stands otherwise than in the first one by a turn about the Earth's axis, as by a wrong time.

    A camera that is moved by hand hardly ever turns about that axis alone.

    Returns:
        number of the image, and what to tell.
    """
    found = []
    on_earth = [number for number, image in enumerate(images) if image.on_earth]
    for number in on_earth[1:]:
        first, other = images[on_earth[0]], images[number]
        assert first.view.origin is not None
        turn = vector_from_rotation(first.attitude.rotation.T @ other.attitude.rotation)
        pole = torch.from_numpy(pole_in_enu(first.view.origin.lat))
        about = float(turn @ pole)
        beside = float((turn - about * pole).norm())
        spread = first.attitude.covariance + other.attitude.covariance
        aside = _SURE * math.sqrt(float(spread.trace())) + math.radians(_BENDS)
        along = _SURE * math.sqrt(float(pole @ spread @ pole)) + math.radians(_BENDS)
        if abs(about) > along and beside < aside:
            seconds = about / EARTH_RATE
            found.append((
                number,
                f"the camera would have turned about the Earth's axis by {math.degrees(about):+.3f}° since the first "
                f"image, as if one of the two times were wrong by {abs(seconds):.0f} s ({abs(seconds) / 3600:.2f} h)",
            ))  # fmt: skip
    return found
