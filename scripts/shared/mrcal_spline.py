"""mrcal's splined lens on one set of corners, by `scripts/bench/peer_mrcal.py` in the interpreter `KCAL_MRCAL`."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from kcal.corners.board import Board


def splined(
    lens: str,
    corners: np.ndarray,
    weight: np.ndarray,
    held: np.ndarray,
    *,
    size: tuple[int, int],
    board: Board,
    focal: float,
    field_of_view: int | None = None,
    timeout: float | None = None,
) -> dict[str, Any]:
    """Fit a spline to all views but those held out: seconds, the lens, and w² |r|² of the latter with its count.

    Args:
        lens: for example SPLINED11x8.
        corners: (V, N, 2) pixels.
        weight: (V, N).
        held: numbers of the views that are held out.
        size: of the image.
        board: of the corners.
        focal: about the focal length, pixels.
        field_of_view: degrees that the splines cover along x, around the given focal length; None: 170, around the
            focal length that mrcal finds.
        timeout: seconds.

    Raises:
        subprocess.SubprocessError: mrcal failed, or took longer.
    """
    field = [] if field_of_view is None else [str(field_of_view)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "problem.npz")
        np.savez(
            path,
            corners=corners,
            weight=weight,
            train=np.setdiff1d(np.arange(len(corners)), held),
            held=held,
            image_size=np.array(size),
            board_size=np.array([board.columns, board.rows]),
            square_m=board.square,
            focal=focal,
        )
        done = subprocess.run(
            [os.environ["KCAL_MRCAL"], "scripts/bench/peer_mrcal.py", str(path), lens, *field],
            capture_output=True, text=True, timeout=timeout, check=True,
        )  # fmt: skip
    found: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return found
