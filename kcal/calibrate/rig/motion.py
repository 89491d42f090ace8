"""Boards that move while the rows of a rig's images are read: how much by evidence, and taken out of the residuals.

Each board has, in each camera, a motion of its own beside its pose (`kcal.calibrate.problem.readout`). Integrated out
under a normal prior, whitened residuals r have the covariance I + U Uᵀ, U being their derivatives by the motion times
its standard deviations, and (I + U Uᵀ)^-½ r takes the place of r.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.hybrid.amplitudes import expected_maximum
from kcal.calibrate.hybrid.evidence import WORTH, evidence_of_motion, maximize_evidence
from kcal.calibrate.hybrid.families import Hyperprior, PriorFamilies
from kcal.calibrate.hybrid.quadratic import ViewData, view_data
from kcal.calibrate.problem.readout import AMPLITUDES, FELT, MEDIAN, MOTION, MotionSigma, Readout, motion_sigma
from kcal.lens.model import LensModel
from kcal.lens.projection import project_components
from kcal.solve.schur import Products, without_local

# Nats by which motions must raise the evidence without the board that tells most of them.
_WORTH_OF_OTHERS = 1.0
# Mean square of residuals, in standard deviations, below which corners have no noise.
_EXACT = 0.01
_POSE = 6
# How far what boards share may move their corners, in standard deviations of the noise: nothing is known beforehand.
_WIDE = 1e3
# Of fewer boards, one that is wrong cannot be told from motion.
_FEWEST = 3
# One amplitude, which stands for none.
_NONE = torch.zeros(1, dtype=torch.float64)
_NO_PRIOR = Hyperprior(_NONE, torch.ones_like(_NONE))


class SeenBoards(NamedTuple):
    """Boards as one camera sees them.

    Attributes:
        model: of the camera.
        parameters: of the camera.
        rotation: (V, 3, 3) cam_from_board.
        translation: (V, 3) meters.
        points: (3, N) the board, meters.
        pixels: (V, N, 2), NaN where not seen.
        whitening: (V, 2, 2, N) by which residuals are multiplied; zero where not seen.
        size: of the image.
    """

    model: LensModel
    parameters: Tensor
    rotation: Tensor
    translation: Tensor
    points: Tensor
    pixels: Tensor
    whitening: Tensor
    size: tuple[int, int]


class BoardMotion(NamedTuple):
    """How boards move while a camera reads its rows.

    Attributes:
        columns: (V, 12, 2, N) derivatives of pixels by a motion, times its standard deviations.
        sigma: standard deviations of motions.
        reach: of the board about its middle, distances of the board.
    """

    columns: Tensor
    sigma: MotionSigma
    reach: float


def board_motion(seen: SeenBoards, rows: Tensor, start: int, good: Tensor) -> BoardMotion | None:
    """How boards move while this camera reads its rows; None where they stand still.

    Args:
        seen: all boards.
        rows: (V, 6 + S + 1, R) of all cameras, whitened, other cameras' motions integrated out: derivatives of
            residuals by the boards' poses and by what they share, and the residuals.
        start: where the 2 N rows of this camera begin.
        good: (V,) of which boards the motion is told.
    """
    points_cam = seen.rotation @ seen.points + seen.translation[..., None]
    found = project_components(points_cam, seen.parameters, seen.model, [])
    good = good & rows.isfinite().all(-1).all(-1)
    if int(good.sum()) < _FEWEST:
        return None
    distance = float(seen.translation[good].norm(dim=-1).median())
    readout = Readout(center=seen.points.mean(-1), distance=distance, size=seen.size)
    columns = readout.columns_of(found.by_point, seen.rotation, readout.time(seen.pixels), seen.points).nan_to_num(0.0)
    white = torch.einsum("vuwn,vpwn->vpun", seen.whitening, columns).flatten(-2)
    moving = torch.zeros(*white.shape[:2], rows.shape[-1], dtype=rows.dtype)
    moving[..., start : start + white.shape[-1]] = white
    off = without_local(torch.cat([rows[:, :_POSE], moving, rows[:, _POSE:]], 1)[good], _POSE)
    counts = (rows[good, :_POSE] != 0).any(1).sum(-1) - _POSE
    shared = off[:, MOTION:-1].transpose(0, 1).flatten(1).norm(dim=1)
    families = _hardly_known(torch.where(shared > 0, _WIDE / shared, 0.0))
    zero = torch.zeros_like(shared)

    def told_by(views: Tensor) -> ViewData:
        products = Products.of_rows(off[views, :MOTION], off[views, MOTION:])
        return view_data(products, zero, off.new_zeros(len(products.local), MOTION), float(counts[views].sum()))

    every = torch.ones(len(off), dtype=torch.bool)
    data = told_by(every)
    variance = float(off[:, -1].square().sum()) / max(float(counts.sum()), 1.0)
    # Nothing is left to explain of corners without noise.
    if variance < _EXACT:
        return None
    begin = np.full(AMPLITUDES, math.log(MEDIAN) - 0.5 * math.log(variance))
    best = maximize_evidence(data, families, _NONE, variance, _NO_PRIOR, begin)
    # What a single board tells of is wrong with that board.
    explained = data.integrated(best.log_ratio).half[..., -1].square().sum(-1)
    others = every.clone()
    others[int(explained.argmax())] = False
    if evidence_of_motion(data, best, families, 1.0) < WORTH:
        return None
    if evidence_of_motion(told_by(others), best, families, 1.0) < _WORTH_OF_OTHERS:
        return None
    sigma = motion_sigma(expected_maximum(data, families, best, _NO_PRIOR).log_ratio, best.variance)
    each = torch.tensor(sigma, dtype=torch.float64).repeat_interleave(MOTION // AMPLITUDES)
    return BoardMotion(columns * each[:, None, None], sigma, readout.reach(seen.points.T))


def _hardly_known(deviation: Tensor) -> PriorFamilies:
    """Priors of unknowns about zero with these standard deviations; unknowns of no effect are held."""
    none = torch.full(deviation.shape, -1)
    return PriorFamilies(torch.zeros_like(deviation), deviation.log(), none, none, torch.zeros_like(deviation))


class WithoutMotion:
    """(I + U Uᵀ)^-½ of each view of a camera.

    Args:
        columns: (V, 12, 2, N) as `BoardMotion.columns`.
        whitening: (V, 2, 2, N).
    """

    def __init__(self, columns: Tensor, whitening: Tensor) -> None:
        self._columns = torch.einsum("vuwn,vpwn->vpun", whitening, columns).flatten(-2)
        values, vectors = torch.linalg.eigh(self._columns @ self._columns.transpose(-1, -2))
        root = (1.0 + values.clamp_min(0.0)).sqrt()
        # (1 / √(1 + λ) - 1) / λ, for small λ too.
        shrink = -1.0 / (root * (1.0 + root))
        self._inner = (vectors * shrink[:, None]) @ vectors.transpose(-1, -2)

    def __call__(self, rows: Tensor) -> Tensor:
        """(V, P, R) whitened rows, with motions integrated out."""
        along = rows @ self._columns.transpose(-1, -2)
        return rows + along @ self._inner @ self._columns


def moved_warnings(
    names: Sequence[str], focal: Sequence[float], motions: Sequence[BoardMotion | None], noise: float
) -> list[str]:
    """One warning for each camera before which boards moved by much more than the noise of a corner, in pixels."""
    found = []
    for name, length, motion in zip(names, focal, motions, strict=True):
        moved = 0.0 if motion is None else motion.sigma.moved(length, motion.reach)
        if moved > FELT * noise:
            found.append(
                f"the boards or the {name} camera moved while rows were read (rolling shutter), by some {moved:.1f} px "
                "from the first row to the last: this is taken out, and the covariance allows for it; stands make it "
                "smaller (if nothing moved, pairs are mixed up or a camera is wrong)"
            )
    return found
