"""What the search for a board in one image gives."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

from torch import Tensor

from kcal.corners.saddle import CornerStatus, Refined
from kcal.texts import brief

_STATUS_TEXTS = {
    CornerStatus.OUTSIDE: "too near the image's edge",
    CornerStatus.NO_SADDLE: "not a corner",
    CornerStatus.MOVED: "moved too far",
    CornerStatus.NOT_CONVERGED: "did not converge",
    CornerStatus.SATURATED: "over- or underexposed",
    CornerStatus.OCCLUDED: "covered or glaring",
    CornerStatus.BLURRED: "too blurred",
}
_CURES = {
    CornerStatus.OUTSIDE: "keep the whole board in the image",
    CornerStatus.NO_SADDLE: "hold still and focus",
    CornerStatus.MOVED: "hold still and focus",
    CornerStatus.NOT_CONVERGED: "hold still, focus, and switch off the camera's sharpening",
    CornerStatus.SATURATED: "expose less",
    CornerStatus.OCCLUDED: "light more evenly, and keep hands off the squares",
    CornerStatus.BLURRED: "focus, hold still or move closer",
}


class Detection(NamedTuple):
    """What was found of a board in an image.

    Args:
        pixels: (corners, 2) float64 in the board's order, NaN where not seen; None if no board was found.
        reason: why none was found.
        covariance: (corners, 2, 2) px², if the refinement estimates it.
        legacy: of a ChArUco board, whether its numbering is that of OpenCV before 4.6; None where it makes no
            difference.
        rejected: (N, 2) corners that were found where no board was, if any; NaN for those that were not.
    """

    pixels: Tensor | None
    reason: str = ""
    covariance: Tensor | None = None
    legacy: bool | None = None
    rejected: Tensor | None = None

    def __repr__(self) -> str:
        return brief(self)


def too_few(refined: Refined, found: int) -> str:
    """Why too few of the points found could be refined, and what to do."""
    good = int((refined.status == CornerStatus.GOOD).sum())
    counts = Counter(refined.status.tolist())
    why = ", ".join(f"{counts[code]} {text}" for code, text in _STATUS_TEXTS.items() if counts[code])
    worst = max(_CURES, key=lambda code: counts[code])
    cure = f"; {_CURES[worst]}" if counts[worst] else ""
    return f"only {good} of {found} corners could be refined ({why}){cure}"
