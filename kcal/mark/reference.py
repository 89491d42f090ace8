"""Find the points of an earlier session again in new images, for the operator to confirm."""

from __future__ import annotations

import math
from pathlib import Path

import torch

from kcal.corners.images import Gray
from kcal.corners.match import MatchStatus
from kcal.corners.refind import find_again
from kcal.errors import InputError
from kcal.locate.marks import Marks, read_marks
from kcal.mark.guide import Proposal
from kcal.mark.items import Side
from kcal.mark.pictures import Pictures, open_pictures

_REFUSALS = {
    MatchStatus.NO_RAY: "it has no mark there",
    MatchStatus.OUTSIDE: "not found: it was or is too near the image's border",
    MatchStatus.FLAT: "not found: there is no texture around it in the old image",
    MatchStatus.NO_MATCH: "not found: nothing nearby looks like it; is it hidden, or has the camera turned more?",
    MatchStatus.AMBIGUOUS: "not found: several places nearby look alike",
    MatchStatus.NOT_CONVERGED: "not found: the fit did not converge",
}


class Reference:
    """Marks of static things in old images.

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
        """Where a thing is now, or why it was not found.

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
            return Proposal(_REFUSALS[status], score=score)
        covariance = found.covariance[0]
        cov = (float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1]))
        u, v = found.pixels[0].tolist()
        return Proposal("", u, v, cov, score, math.nan)
