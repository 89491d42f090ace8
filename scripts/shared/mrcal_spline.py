"""mrcal or lensboy on one set of corners, by `scripts/bench/peer_NAME.py` in the interpreter `KCAL_NAME`."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from kcal.corners.board import Board
from scripts.shared.children import answered, interpreter


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
    peer: str = "mrcal",
) -> dict[str, Any]:
    """Fit a spline to all views but those held out: seconds, the lens, and w² |r|² of the latter with its count.

    Args:
        lens: for example SPLINED11x8; of lensboy OPENCV14, too.
        corners: (V, N, 2) pixels.
        weight: (V, N).
        held: numbers of the views that are held out.
        size: of the image.
        board: of the corners.
        focal: about the focal length, pixels.
        field_of_view: degrees that the splines cover along x, around the given focal length; None: 170, around the
            focal length that mrcal finds.
        timeout: seconds.
        peer: mrcal or lensboy.

    Raises:
        subprocess.SubprocessError: it failed, or took longer.
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
        return answered(interpreter(peer), f"scripts/bench/peer_{peer}.py", path, lens, *field, timeout=timeout)
