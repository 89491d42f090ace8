"""Whether the times of night images can be right, from a camera that stands still.

What no image tells: a place or a clock that is wrong by the same in all images, where they look high up and refraction
(`kcal.stars.attitude.refraction_doubt`) says little of the altitude. Landmarks or a compass tell it then.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from kcal.lens.pose import vector_from_rotation
from kcal.stars.night import NamedStars
from kcal.stars.sky import EARTH_RATE, pole_in_enu

# Standard deviations beyond which chance explains nothing.
_SURE = 5.0
# Degrees by which a mast may bend between two images.
_BENDS = 0.02


def clock_doubts(images: Sequence[NamedStars]) -> list[tuple[int, str]]:
    """Images whose camera stands otherwise than in the first one by a turn about the Earth's axis, as by a wrong time.

    A camera that is moved by hand hardly ever turns about that axis alone.

    Returns:
        number of the image, and what to tell.

    Example:
        >>> clock_doubts([])
        []
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
