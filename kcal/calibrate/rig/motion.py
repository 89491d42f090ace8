"""How rays of a camera change with what a rig estimates: its own parameters, and its motion while rows are read."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.hybrid.evidence import (
    WORTH,
    Amplitudes,
    Quadratic,
    ViewData,
    evidence_of_motion,
    expected_maximum,
    loss_at,
    maximize_evidence,
)
from kcal.calibrate.hybrid.families import Hyperprior, PriorFamilies
from kcal.calibrate.problem.state import AMPLITUDES, APART, AXES, FELT, MEDIAN, MotionSigma
from kcal.finding import Finding
from kcal.solve.schur import Products, column_scale

# Rows of each camera of a rig, and their products, without the many columns that are zero for it.
#
# What a camera sees depends on poses of boards, on its own pose and lens, and on the board: on no other camera. So the
# work for C cameras grows with what they see, and not with what they see times C².


class CameraRows(NamedTuple):
    """Rows of one camera, without the columns that are zero for it; or of what is known of the items beforehand.

    Attributes:
        camera: its number; None for what is known beforehand.
        columns: (U,) numbers of the shared unknowns that move what it sees.
        rows: (V, L + U + 1, R): derivatives of whitened residuals by local and these shared unknowns; last residuals.
    """

    camera: int | None
    columns: Tensor
    rows: Tensor


def summed_products(parts: Sequence[CameraRows], size: int, shared_size: int) -> Products:
    """Products of the rows of all cameras, each formed without the columns that are zero for the camera.

    Args:
        parts: of items.
        size: number of each item's own unknowns.
        shared_size: number of the shared ones.
    """
    count, width = len(parts[0].rows), shared_size + 1
    new = parts[0].rows.new_zeros
    local, right, score, total = new(count, size, size), new(count, size, width), new(count, width), new(width, width)
    for _, shared, rows in parts:
        own, columns = Products.of_rows(rows, size), torch.cat([shared, shared.new_tensor([-1])])
        local += own.local
        right[..., columns] += own.right
        score[:, columns] += own.score
        total[columns[:, None], columns] += own.total
    return Products(local, right, score, total)


# Boards that move while the rows of a rig's images are read: how much by evidence, and taken out of the residuals.
#
# Each board has, in each camera, a motion of its own beside its pose (`kcal.calibrate.problem.state`). Integrated out
# under a normal prior, whitened residuals r have the covariance I + U Uᵀ, U being their derivatives by the motion times
# its standard deviations, and (I + U Uᵀ)^-½ r takes the place of r.

# Nats by which a shift of the image must be likelier than a motion of the board where boards moved before another
# camera, because hands do not move as the prior says: 9 of two webcams without a stabilizer.
_CLEARLY = 20.0
# Nats by which motions must raise the evidence of the other boards, without the one that shows most motion.
_WORTH_OF_OTHERS = 1.0
# Mean square of residuals, in standard deviations, below which corners have no noise.
_EXACT = 0.01
_POSE = 6
# Prior width of shared unknowns, as movement of corners in standard deviations of their noise: nearly no prior.
_WIDE = 1e3
# Readouts by which exposures must be apart to be called apart.
_OTHER_MOMENT = 0.4
# Of fewer boards, one that is wrong cannot be told from motion.
_FEWEST = 3
# One amplitude, which stands for none.
_NONE = torch.zeros(1, dtype=torch.float64)
_NO_PRIOR = Hyperprior(_NONE, torch.ones_like(_NONE))


class BoardMotion(NamedTuple):
    """How boards move while a camera reads its rows, and between the exposures of cameras that are not synchronized.

    Attributes:
        columns: (V, M, 2, N) derivatives of pixels by a motion, times its standard deviations.
        sigma: standard deviations of motions while rows are read.
        apart: of turns and shifts between the exposures, in the same units.
        reach: of the board about its middle, distances of the board.
        image: pixels by which a stabilizer shifts the image of each view along each axis, in place of `apart`.
    """

    columns: Tensor
    sigma: MotionSigma
    apart: tuple[float, float]
    reach: float
    image: float


def board_motion(
    columns: Tensor, weighted: Callable[[Tensor], Tensor], focal: float, reach: float, rig: RigRows, camera: int,
    *, apart: bool = False,
) -> BoardMotion | None:  # fmt: skip
    """Estimate how boards move while a camera reads its rows, and between exposures; None where they stand still.

    What differs from exposure to exposure is a motion of the boards, or a shift of the image, whichever is likelier.

    Args:
        columns: (V, 18, 2, N) derivatives of its pixels by motions; (V, 6, 2, N) if they do not move while rows are
            read.
        weighted: makes of such derivatives those (V, M, R) of the camera's rows, in standard deviations of residuals.
        focal: length of the camera, pixels.
        reach: of the board about its middle, distances of the board.
        rig: rows of all cameras, other cameras' motions integrated out.
        camera: its number.
        apart: boards moved between the exposures of another camera.
    """
    good = rig.good
    if int(good.sum()) < _FEWEST or camera not in rig.parts:
        return None
    variance = rig.variance
    # Residuals without noise need no motion to explain them.
    if variance < _EXACT:
        return None
    white = weighted(columns)
    data, families, best, _ = found = _amplitudes(white, rig, camera)
    if evidence_of_motion(data, best, families, 1.0) < WORTH:
        return None
    shifts = torch.cat([columns[:, :-_POSE], torch.zeros_like(columns[:, -_POSE:])], 1)
    shifts[:, -3, 0] = shifts[:, -2, 1] = APART * focal
    other = _amplitudes(weighted(shifts), rig, camera)
    if by_image := other[-1] < found[-1] - (_CLEARLY if apart else WORTH):
        columns, white, found = shifts, weighted(shifts), other
    data, families, best, _ = found
    # Motion that a single board shows is an error of that board.
    explained = data.integrated(best.log_ratio).half[..., -1].square().sum(-1)
    others = rig.without(int(good.nonzero()[explained.argmax(), 0]))
    rest, their_families = others.told(camera, white)
    if evidence_of_motion(rest, best, their_families, 1.0) < _WORTH_OF_OTHERS:
        return None
    best = expected_maximum(data, families, best, _NO_PRIOR)
    *sigma, turn, shift = (np.exp(best.log_ratio) * math.sqrt(best.variance)).tolist()
    each = torch.tensor([*sigma, turn, shift], dtype=torch.float64).repeat_interleave(AXES)
    return BoardMotion(
        columns * each[:, None, None],
        MotionSigma(*sigma or (0.0,) * AMPLITUDES),
        (0.0, 0.0) if by_image else (APART * turn, APART * shift),
        reach,
        APART * focal * shift * by_image,
    )


def _amplitudes(white: Tensor, rig: RigRows, camera: int) -> tuple[ViewData, PriorFamilies, Amplitudes, float]:
    """What the boards say of motions (V, M, R), the amplitudes of largest evidence, and its negative logarithm."""
    data, families = rig.told(camera, white)
    begin = np.full(white.shape[1] // AXES, math.log(MEDIAN) - 0.5 * math.log(rig.variance))
    best = maximize_evidence(data, families, Amplitudes(_NONE, rig.variance, begin), _NO_PRIOR)
    # What motions do not feel has its part in the evidence, too: other motions feel other combinations.
    unfelt = 0.5 * (rig.shared_size - len(data.still.at)) * math.log1p(_WIDE**2 / best.variance)
    return data, families, best, loss_at(data, best, families, 1.0) + unfelt


class RigRows:
    """Rows of all cameras of a rig, from which the motion of boards is estimated camera by camera.

    Args:
        parts: `CameraRows` of the cameras, whitened: derivatives of residuals by the boards' poses and by what boards
            share, and the residuals.
        good: (V,) which boards are used to estimate motion; those without finite rows are left out.
        shared_size: number of the unknowns that boards share.
    """

    def __init__(self, parts: Iterable[CameraRows], good: Tensor, shared_size: int) -> None:
        self.parts = {part.camera: part for part in parts}
        finite = [part.rows.isfinite().all(-1).all(-1) for part in self.parts.values()]
        self.good, self.shared_size = torch.stack([good, *finite]).all(0), shared_size

    def put(self, camera: int, rows: Tensor) -> None:
        """Replace the rows of a camera."""
        self.parts[camera] = self.parts[camera]._replace(rows=rows)
        self.__dict__.pop("whole", None)

    def without(self, board: int) -> RigRows:
        """These rows, with one board no longer among the good ones."""
        good = self.good.clone()
        good[board] = False
        return RigRows(self.parts.values(), good, self.shared_size)

    @property
    def variance(self) -> float:
        """Mean square of the residuals, in standard deviations, as boards that stand still leave them."""
        return self.whole.variance

    @functools.cached_property
    def whole(self) -> _Whole:
        """All cameras together; formed once, as long as their rows are the same."""
        some = [part._replace(rows=part.rows[self.good]) for part in self.parts.values()]
        residuals = sum(int((part.rows[:, :_POSE] != 0).any(1).sum()) for part in some)
        count = residuals - _POSE * int(self.good.sum())
        return _Whole.of(summed_products(some, _POSE, self.shared_size), count)

    def told(self, camera: int, white: Tensor) -> tuple[ViewData, PriorFamilies]:
        """Evidence of the good boards on their motions before a camera, with poses and shared unknowns integrated out.

        Shared unknowns enter as combinations that are independent and of unit weight where all boards stand still:
        those that the boards' poses or the camera feel. Most others are of other cameras.

        Args:
            camera: its number.
            white: (V, 12, 2 N) derivatives of the camera's whitened residuals by motions.
        """
        whole, (_, shared, rows) = self.whole, self.parts[camera]
        moving, rows = white[self.good], rows[self.good]
        # Products with the poses, such that squares of them are what poses explain.
        by_pose = torch.linalg.solve_triangular(whole.pose, (moving @ rows[:, :_POSE].mT).mT, upper=False).mT
        direct = moving @ rows[:, _POSE:].mT
        own = moving @ moving.mT - by_pose @ by_pose.mT
        seen = torch.zeros_like(whole.root[:, : len(shared)])
        seen[shared, range(len(shared))] = whole.scale[shared]
        seen = torch.linalg.solve_triangular(whole.root, seen, upper=False)
        basis, felt = torch.linalg.qr(torch.cat([whole.posed, seen], 1))
        by_poses, by_seen = felt.split([whole.posed.shape[1], len(shared)], 1)
        cross = direct[..., :-1] @ by_seen.T - by_pose @ by_poses.unflatten(1, (-1, _POSE)).permute(1, 2, 0)
        cross = torch.cat([cross, direct[..., -1:] - by_pose @ whole.half[..., -1:]], -1)
        pull = basis.T @ whole.pull
        square = whole.square - float(whole.pull.square().sum() - pull.square().sum())
        # Of more unknowns than motions, some are determined by nothing.
        many = own.shape[0] * own.shape[1] < len(basis)
        freedom = whole.freedom - ((whole.determined if many else len(basis)) - len(pull))
        size = len(pull)
        products = torch.eye(size + 1, dtype=pull.dtype)
        products[-1, :-1] = products[:-1, -1] = pull
        products[-1, -1] = square
        still = Quadratic(products, freedom, torch.zeros_like(pull))
        data = ViewData(still=still, own=own, cross=cross, score=pull.new_zeros(len(moving), size))
        zero, none = torch.zeros_like(pull), torch.full(pull.shape, -1)
        return data, PriorFamilies(zero, torch.full_like(pull, math.log(_WIDE)), none, none, zero)


class _Whole(NamedTuple):
    """Products of all cameras' rows off the boards' poses.

    Attributes:
        pose: (V, 6, 6) lower triangles of the poses' own products.
        half: (V, 6, S + 1) their inverses times the products with what boards share, and with the residuals.
        scale: (S,) of what boards share; zero where nothing depends on it.
        root: (S, S) lower triangle of its products in this scale, what is hardly known included.
        pull: (S,) products with the residuals, in combinations of unit weight.
        posed: (S, 6 V) what the boards' poses feel of these combinations.
        determined: how many of these combinations the boards determine.
        freedom: residuals, less those that poses take up.
        square: of all residuals.
        variance: mean of that.
    """

    pose: Tensor
    half: Tensor
    scale: Tensor
    root: Tensor
    pull: Tensor
    posed: Tensor
    determined: float
    freedom: int
    square: float
    variance: float

    @classmethod
    def of(cls, products: Products, count: int) -> _Whole:
        """From products with the poses."""
        scale = column_scale(products.local.diagonal(dim1=-2, dim2=-1))[..., None]
        pose = torch.linalg.cholesky_ex(products.local * scale * scale.mT)[0] / scale
        half = torch.linalg.solve_triangular(pose, products.right, upper=False)
        flat = half.flatten(0, 1)
        total = products.total - flat.T @ flat
        square = float(total[-1, -1])
        variance = square / max(count, 1)
        length = total.diagonal()[:-1].clamp_min(0.0).sqrt()
        unit = torch.where(length > 0, 1.0 / length, 0.0)
        # Of corners without noise no motion is asked; their products may determine nothing to the last digit.
        matrix, weak = total[:-1, :-1] * unit[:, None] * unit, max(variance, _EXACT) / _WIDE**2
        matrix.diagonal().add_(torch.where(length > 0, weak, 1.0))
        root = torch.linalg.cholesky(matrix)
        pull = torch.linalg.solve_triangular(root, (total[:-1, -1] * unit)[:, None], upper=False)[:, 0]
        posed = torch.linalg.solve_triangular(root, flat[:, :-1].T * unit[:, None], upper=False)
        inverse = torch.linalg.solve_triangular(root, torch.diag((length > 0).to(root.dtype)), upper=False)
        determined = int((length > 0).sum()) - weak * float(inverse.square().sum())
        return cls(pose, half, unit, root, pull, posed, determined, count, square, variance)


class WithoutMotion:
    """(I + U Uᵀ)^-½ of each view of a camera.

    Args:
        columns: (V, 12, R) as `BoardMotion.columns`, of the rows of the camera, in standard deviations.
    """

    def __init__(self, columns: Tensor) -> None:
        self._columns = columns
        values, vectors = torch.linalg.eigh(self._columns @ self._columns.transpose(-1, -2))
        root = (1.0 + values.clamp_min(0.0)).sqrt()
        # (1 / √(1 + λ) - 1) / λ, for small λ too.
        shrink = -1.0 / (root * (1.0 + root))
        self._inner = (vectors * shrink[:, None]) @ vectors.transpose(-1, -2)

    def __call__(self, rows: Tensor) -> Tensor:
        """(V, P, R) whitened rows, with motions integrated out."""
        along = rows @ self._columns.transpose(-1, -2)
        return rows + along @ self._inner @ self._columns


def moved_findings(
    names: Sequence[str], focal: Sequence[float], motions: Sequence[BoardMotion | None], noise: float
) -> list[Finding]:
    """One doubt for each camera before which boards moved by much more than the noise of a corner, in pixels."""
    found = []
    for name, length, motion in zip(names, focal, motions, strict=True):
        moved = 0.0 if motion is None else motion.sigma.moved(length, motion.reach)
        if moved > FELT * noise:
            text = (
                f"the boards or the {name} camera moved while rows were read (rolling shutter), by some {moved:.1f} px "
                "from the first row to the last: this is taken out, and the covariance allows for it"
            )
            action = "stands make it smaller (if nothing moved, pairs are mixed up or a camera is wrong)"
            found.append(Finding("moved", "doubt", text, action))
    return found


def scatter_findings(focal: Sequence[float], motions: Sequence[BoardMotion | None], noise: float) -> list[Finding]:
    """A doubt where the cameras' relative pose differs from pair to pair by much more than the noise, in pixels."""
    moving = [(length, motion) for length, motion in zip(focal, motions, strict=True) if motion is not None]
    off = math.hypot(*(length * math.hypot(one.apart[1], one.reach * one.apart[0]) for length, one in moving))
    # What rolling shutters leave open of boards that move during one exposure is no matter of another moment.
    if off <= max(
        FELT * noise, _OTHER_MOMENT * math.hypot(*(one.sigma.moved(length, one.reach) for length, one in moving))
    ):
        return []
    text = (
        f"the cameras' relative pose differs from pair to pair by some {off:.1f} px, {off / noise:.0f} times the noise "
        "of a corner: were both views of each pair taken at the same moment, of a board at rest? Each pair counts with "
        "such an error, and the covariance allows for it"
    )
    action = "trigger the cameras together, or put the board on a stand (if nothing moved, a camera is wrong)"
    return [Finding("synchronization", "doubt", text, action)]
