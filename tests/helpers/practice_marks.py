"""Marks of a practice site from its truth with noise, through the session that `kcal mark` keeps."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from kcal.mark.items import Add, Mark, Put, Side
from kcal.mark.session import Session

SIDES: tuple[Side, Side] = ("left", "right")


def mark_practice(folder: Path, sigma: float = 0.3, seed: int = 0) -> None:
    """Mark all landmarks and targets as somebody would by hand, with Gaussian noise of `sigma` pixels."""
    truth = json.loads((folder / ".truth" / "truth.json").read_text())
    random = np.random.default_rng(seed)
    session = Session(folder / "marks.csv", folder / "survey.csv", sigma)
    try:
        for name in truth["targets"]:
            session.do(Add(do="add", name=name, kind="target"), f"add {name}")
        for name, pixels in truth["marks"].items():
            seen = np.array(pixels).reshape(2, 2) + sigma * random.standard_normal((2, 2))
            for side, (u, v) in zip(SIDES, seen.tolist(), strict=True):
                mark = Mark(u=u, v=v, cov=(sigma**2, 0.0, sigma**2), frame="0", how="hand")
                session.do(Put(do="put", name=name, side=side, mark=mark), f"{name} {side}")
    finally:
        session.close()
