"""The captures with ordinary cameras that KCAL_DATA holds, and how each is split into halves."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from kcal import Board, Observations, detect
from kcal.corners.images import expand_images
from kcal.corners.refine import Refinement
from scripts.shared import wide_lens
from scripts.shared.wide_lens import data_folder

# Folders of images, and their boards. The squares of gloworm960 are not known; no figure depends on them.
FOLDERS = {"pi640": Board(columns=7, rows=7, square=0.0254), "gloworm960": Board(columns=8, rows=6, square=0.0254)}
CACHE = Path(tempfile.gettempdir(), "kcal-ordinary-corners")
STEREO_BOARD = Board(columns=9, rows=6, square=0.025)


class RealCapture(NamedTuple):
    """All views of one camera, in natural order of their names, and weights (V, N) of their residuals."""

    seen: Observations
    weight: Tensor

    def half(self, which: int) -> RealCapture:
        """Every other view."""
        return RealCapture(self.seen.subset(list(self.seen.names[which::2])), self.weight[which::2])


def names() -> list[str]:
    """All captures in KCAL_DATA."""
    files = sorted(path.name.removesuffix(".obs.json") for path in (data_folder() / "captures").glob("*.obs.json"))
    return [*files, *FOLDERS, "wide", "stereo_left", "stereo_right"]


def load(name: str) -> RealCapture:
    """A capture by name, or an observations file by its path; corners found in images are stored in `CACHE`.

    The cache is not aware of the detector's version: use another folder, or delete it, after a change.
    """
    folder = data_folder()
    if name == "wide":
        seen, weights = wide_lens.load()
        return RealCapture(seen, torch.from_numpy(weights))
    if name in FOLDERS:
        seen = _detected(name, lambda: detect(expand_images([str(folder / "captures" / name)]), FOLDERS[name]))
    elif name.startswith("stereo_"):
        seen = _detected(name, lambda: stereo_images(name.removeprefix("stereo_")))
    else:
        path = folder / "captures" / f"{name}.obs.json"
        seen = Observations.load(path if path.exists() else Path(name))
    seen = seen.subset(sorted(seen.names, key=_natural))
    return RealCapture(seen, torch.isfinite(seen.pixels()).all(-1).double())


def _detected(name: str, detect: Callable[[], Observations]) -> Observations:
    path = CACHE / f"{name}.obs.json"
    if not path.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        detect().save(path)
    return Observations.load(path)


def _natural(name: str) -> list[tuple[int, str]]:
    """A key that sorts img2 before img10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def stereo_images(side: str, refine: Refinement = "erf") -> Observations:
    """OpenCV's own images of the left or the right camera, 13 views of a board of 9x6 corners."""
    images = expand_images([str(data_folder() / "opencv_stereo")])
    return detect([path for path in images if path.name.startswith(side)], STEREO_BOARD, refine)
