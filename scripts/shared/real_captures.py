"""The captures with ordinary cameras that KCAL_DATA holds, and how each is split into halves."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from kcal import Board, Observations, detect
from kcal.corners.images import expand_images
from scripts.shared import wide_lens

# Folders of images, and their boards. The squares of gloworm960 are not known; no figure depends on them.
FOLDERS = {
    "pi640": Board(columns=7, rows=7, square=0.0254),
    "gloworm960": Board(columns=8, rows=6, square=0.0254),
}
STEREO_BOARD = Board(columns=9, rows=6, square=0.025)


class RealCapture(NamedTuple):
    """All views of one camera, in natural order of their names, and weights (V, N) of their residuals."""

    seen: Observations
    weight: Tensor

    def half(self, which: int) -> RealCapture:
        """Every other view."""
        return RealCapture(self.seen.subset(list(self.seen.names[which::2])), self.weight[which::2])


def names(folder: Path) -> list[str]:
    """All captures of a data folder."""
    files = sorted(path.name.removesuffix(".obs.json") for path in (folder / "captures").glob("*.obs.json"))
    return [*files, *FOLDERS, "wide", "stereo_left", "stereo_right"]


def load(name: str, folder: Path, cache: Path) -> RealCapture:
    """A capture by name, or an observations file by its path; corners found in images are stored in `cache`.

    The cache is not aware of the detector's version: use another folder, or delete it, after a change.
    """
    if name == "wide":
        seen, weights = wide_lens.load()
        return RealCapture(seen, torch.from_numpy(weights))
    if name in FOLDERS:
        seen = _detected(name, lambda: detect(_images(folder / "captures" / name), FOLDERS[name]), cache)
    elif name.startswith("stereo_"):
        side = name.removeprefix("stereo_")
        images = [path for path in _images(folder / "opencv_stereo") if path.name.startswith(side)]
        seen = _detected(name, lambda: detect(images, STEREO_BOARD), cache)
    else:
        path = folder / "captures" / f"{name}.obs.json"
        seen = Observations.load(path if path.exists() else Path(name))
    seen = seen.subset(sorted(seen.names, key=_natural))
    return RealCapture(seen, torch.isfinite(seen.pixels()).all(-1).double())


def data_folder() -> Path:
    """What KCAL_DATA names."""
    folder = os.environ.get("KCAL_DATA")
    if not folder:
        raise SystemExit("set KCAL_DATA to the folder that holds the real captures")
    return Path(folder)


def _images(folder: Path) -> list[Path]:
    return expand_images([str(folder)])


def _detected(name: str, detect: Callable[[], Observations], cache: Path) -> Observations:
    path = cache / f"{name}.obs.json"
    if not path.exists():
        cache.mkdir(parents=True, exist_ok=True)
        detect().save(path)
    return Observations.load(path)


def _natural(name: str) -> list[tuple[int, str]]:
    """A key that sorts img2 before img10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]
