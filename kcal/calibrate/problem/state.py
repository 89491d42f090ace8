"""What the problem of one camera is solved for: camera, board, poses, and motions while rows are read."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

# How a view moves while its rows are read: a rolling shutter before a camera, or a board, that is held by hand.
#
# Row v is read at the time g = (v + ½) / H - ½, from -½ to ½. Beside its pose each view has a motion, of first and of
# second order in g: a turn ω of the board about its centroid c and a shift of it by a multiple of the typical distance
# d,
#
#     X = R (P + ω × (P - c)) + t + d s,   ω = g ω₁ + g² ω₂,   s = g s₁ + g² s₂
#
# ω (radians) is in the board's frame and s in the camera's. Twelve numbers for each view are many; they are integrated
# out under a normal prior, whose four standard deviations the evidence of all views sets: of turns and of shifts, of
# first and of second order (hands turn by more than they shift). Rows that are read upward are the same with another
# sign; where a picture was turned, columns stand for rows.

# A board that flexes has another shape in each view: modes of bending h, as those of its shape in all views, whose
# heights b·h in the board's frame stand beside that shape. These numbers follow those of the motion. They have one
# amplitude, and a prior whose width differs by view (`kcal.calibrate.hybrid.evidence.relative_bends`).

# Numbers of a motion: for each order three of the turn and three of the shift, of which each three have an amplitude.
MOTION = 12
ORDERS = 2
AXES = 3
AMPLITUDES = MOTION // AXES
# Numbers by which a board bends in a view.
BENDS = 12
# Median and standard deviation of the logarithm of a motion's standard deviation: radians, and distances of the board,
# while an image is read. A hand that turns by 1 rad/s moves by 0.03 in 30 ms: beyond it is no motion. Below the
# smallest no pixel feels it.
MEDIAN, SPREAD, SMALLEST, LARGEST = 2e-4, 2.0, 1e-6, 0.03
# Fewer views do not tell whether they moved: lens and board explain a hand's motion nearly as well, and a fit that
# begins with less of it ends far off (docs/measured/ordinary.md). They keep a hand's motion: turns by 0.3 rad/s,
# shifts by 0.1 m/s at 0.8 m, for 20 ms; of second order what a tremor of some Hz adds. And the standard deviation of
# the logarithms of these.
FEW, HAND, HAND_SPREAD = 6, (6e-3, 2.5e-3, 1.5e-3, 6e-4), 0.5
# Readouts between the exposures of two cameras that are not synchronized, typically.
APART = 10.0
# A motion is worth a stand if it moves corners by so many standard deviations of their noise.
FELT = 5.0


# Error bars of six views or some more that moved are too small by themselves: amplitudes of motions are known only
# roughly, and what follows from them is not linear. Views at which variances would be doubled, and the power with which
# this fades: set on 900 simulated captures of 3 to 8 views by hand (docs/measured/ordinary.md).
_DOUBLED, _FADES = 5.2, 3.0


def widening(views: int) -> float:
    """How many times larger variances are than the posterior's, where so many views moved, `FEW` or more.

    Example:
        >>> round(widening(6), 2), round(widening(8), 2), round(widening(60), 3)
        (1.65, 1.27, 1.001)
    """
    return 1.0 + float((_DOUBLED / views) ** _FADES)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Readout:
    """What a view has beside its pose: motion in the order in which the image is read, and bending of its board.

    Args:
        center: (3,) of the board, about which it turns, meters.
        distance: of the board, typically, by which shifts are divided, meters.
        size: of the image.
        columns: whether columns are read one after the other instead of rows, as in a picture that was turned.
        moves: whether views move.
        bends: (12, N), or (V, 12, N) of each view, heights of the corners by modes of bending (`BoardModes.heights`),
            meters; None: it is stiff.

    Example:
        >>> readout = Readout(center=torch.zeros(3), distance=1.0, size=(640, 480))
        >>> readout.time(torch.tensor([[10.0, -0.5], [300.0, 239.5]])).tolist()
        [-0.5, 0.0]
    """

    center: Tensor
    distance: float
    size: tuple[int, int]
    columns: bool = False
    moves: bool = True
    bends: Tensor | None = None

    @property
    def numbers(self) -> int:
        """How many numbers a view has beside its pose."""
        return MOTION * self.moves + BENDS * (self.bends is not None)

    @property
    def per_pixel(self) -> float:
        """Time in which one row, or column, is read."""
        return 1.0 / self.size[0 if self.columns else 1]

    def time(self, pixels: Tensor) -> Tensor:
        """(...) when pixels (..., 2) were read: -½ at the first edge of the image, ½ at the last; 0 where NaN."""
        axis = 0 if self.columns else 1
        return ((pixels[..., axis] + 0.5) / self.size[axis] - 0.5).nan_to_num(0.0)

    def of_views(self, views: slice) -> Readout:
        """The same of some views, where each has heights of its own."""
        if self.bends is None or self.bends.ndim == 2:
            return self
        return dataclasses.replace(self, bends=self.bends[views])

    def reach(self, points: Tensor) -> float:
        """How far corners (N, 3) of the board, meters, are from its middle at most, in distances of the board."""
        return float((points - self.center).norm(dim=-1).max()) / self.distance

    def moved(self, motion: Tensor, time: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Boards as they stand when their corners are read.

        Args:
            motion: (V, M) of each view: ω₁, s₁, ω₂, s₂ where views move, and heights of bending where the board bends.
            time: (V, N) of each corner.
            points: (3, N), or (V, 3, N) of each view, the board, meters.

        Returns:
            (V, 3, N) each: points turned in the board's frame, and their shift in the camera's, meters; ω of each.
        """
        points = points.expand(len(motion), *points.shape[-2:])
        turn = shift = torch.zeros_like(points)
        if self.moves:
            powers = torch.stack([time, time * time], -1)
            turn, shift = torch.einsum("vno,vokj->kvjn", powers, motion[:, :MOTION].unflatten(1, (ORDERS, 2, 3)))
            points = points + torch.linalg.cross(turn, points - self.center[:, None], dim=1)
        if self.bends is not None:
            points = points + torch.nn.functional.pad(motion[:, None, -BENDS:] @ self.bends, (0, 0, 2, 0))
        return points, self.distance * shift, turn

    def columns_of(
        self, by_point: Tensor, rotation: Tensor, time: Tensor, points: Tensor, *, apart: bool = False
    ) -> Tensor:
        """(V, M, 2, N) derivatives of pixels by these numbers; with what happens before the image is read.

        Args:
            by_point: (V, 3, 2, N) of pixels by points in the camera's frame.
            rotation: (V, 3, 3) cam_from_board.
            time: (V, N).
            points: (3, N), or (V, 3, N) of each view, the board, meters.
            apart: last, a motion during `APART` readouts, which all corners share.
        """
        by_board = torch.einsum("vkun,vkl->vlun", by_point, rotation)
        found = []
        if self.moves:
            about = (points - self.center[:, None]).unsqueeze(-2).expand_as(by_board)
            both = torch.cat([torch.linalg.cross(about, by_board, dim=1), self.distance * by_point], 1)
            g = time[:, None, None]
            found = [g * both, g * g * both, *([APART * both] if apart else [])]
        return torch.cat(found if self.bends is None else [*found, by_board[:, 2:] * self.bends[..., None, :]], 1)


def amplitudes_of(count: int) -> np.ndarray:
    """(M,) which of a view's amplitudes each of its numbers has.

    Three numbers of a motion have one; of an odd number of amplitudes the last is that of bending.
    """
    bends = count % 2
    return np.repeat(np.arange(count), [AXES] * (count - bends) + [BENDS] * bends)


def by_number(log_ratio: np.ndarray, relative: Tensor | None = None) -> Tensor:
    """Standard deviations (M,) of the numbers of a view over the noise, from the logarithms of those by amplitude.

    With how much the board bends in each view (V,), relative to the others, (V, M).
    """
    ratio = torch.from_numpy(np.exp(log_ratio)[amplitudes_of(len(log_ratio))])
    if relative is None:
        return ratio
    ratio = ratio.repeat(len(relative), 1)
    ratio[:, -BENDS:] *= relative[:, None]
    return ratio


def usual_motion(count: int, by_hand: bool) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation (A,) of the prior of the logarithms of so many amplitudes of motion and bending."""
    mean, sd = np.full(count, math.log(MEDIAN)), np.full(count, SPREAD)
    if by_hand and count >= AMPLITUDES:
        mean[:AMPLITUDES], sd[:AMPLITUDES] = np.log(HAND), HAND_SPREAD
    return mean, sd


def stillness(log_ratio: np.ndarray, relative: Tensor | None = None) -> Tensor:
    """Weights (M,) or (V, M) of the numbers of views, with arguments as of `by_number`."""
    return by_number(log_ratio, relative) ** -2


class MotionSigma(NamedTuple):
    """Standard deviations of motions along each axis, while an image is read.

    Attributes:
        turn: of first order, radians.
        shift: of first order, distances of the board.
        turn_twice: of second order.
        shift_twice: of second order.
    """

    turn: float
    shift: float
    turn_twice: float
    shift_twice: float

    def moved(self, focal: float, reach: float) -> float:
        """Pixels by which a corner moves from the first row to the last.

        Args:
            focal: length, pixels.
            reach: of the board about its middle, distances of the board.
        """
        # The second order covers a quarter of that, as it is the same at both ends.
        turn, shift = math.hypot(self.turn, 0.25 * self.turn_twice), math.hypot(self.shift, 0.25 * self.shift_twice)
        return focal * math.hypot(shift, reach * turn)


def motion_sigma(log_ratio: np.ndarray, variance: float) -> MotionSigma:
    """Standard deviations of motions.

    Args:
        log_ratio: their logarithms over the noise, the first four.
        variance: of the noise.
    """
    return MotionSigma(*(np.exp(log_ratio[:AMPLITUDES]) * np.sqrt(variance)).tolist())


# What the problem of one camera is solved for: camera, board, poses and motions.


class BoardState(NamedTuple):
    """Camera, board, poses and motions; all tensors may have leading batch dimensions.

    Attributes:
        parameters: (..., 5 + P) fx, fy, cx, cy, skew, coefficients.
        board: (..., B) amplitudes of the board's modes, meters.
        rotation: (..., V, 3, 3) cam_from_board.
        translation: (..., V, 3) cam_from_board, meters.
        motion: (..., V, M) numbers of each view beside its pose (`Readout`): how it moves while it is read, and how its
            board bends; (..., V, 0): neither.

    Example:
        >>> poses = torch.eye(3).expand(4, 3, 3), torch.zeros(4, 3)
        >>> state = BoardState.flat(torch.zeros(9), *poses)
        >>> state.board, tuple(state.views([0, 2]).motion.shape)
        (tensor([0., 0.]), (2, 0))
    """

    parameters: Tensor
    board: Tensor
    rotation: Tensor
    translation: Tensor
    motion: Tensor

    @classmethod
    def still(cls, parameters: Tensor, board: Tensor, rotation: Tensor, translation: Tensor) -> BoardState:
        """The state of views that stand still."""
        return cls(parameters, board, rotation, translation, translation.new_zeros(*translation.shape[:-1], 0))

    @classmethod
    def flat(cls, parameters: Tensor, rotation: Tensor, translation: Tensor) -> BoardState:
        """The state of views that stand still of a board without warp (`warp_modes`)."""
        return cls.still(parameters, parameters.new_zeros((*parameters.shape[:-1], 2)), rotation, translation)

    def views(self, chosen: Sequence[int] | slice | Tensor) -> BoardState:
        """The state of some views only."""
        return self._replace(
            rotation=self.rotation[..., chosen, :, :],
            translation=self.translation[..., chosen, :],
            motion=self.motion[..., chosen, :],
        )


def warp_modes(board_points: Tensor) -> Tensor:
    """How a warped board bulges: two parabolas (2, 3, N), in z, that are 1 in the middle and 0 at the outer corners.

    The board's height above its plane is warp_x (1 - x²) + warp_y (1 - y²), with x and y scaled to ±1 at the outermost
    corners. So each amplitude is the greatest deflection in meters along a direction (as mrcal's first warp model).
    """
    low, high = board_points[:, :2].amin(0), board_points[:, :2].amax(0)
    scaled = (2.0 * board_points[:, :2] - low - high) / (high - low)
    heights = (1.0 - scaled**2).T
    return torch.stack([torch.zeros_like(heights), torch.zeros_like(heights), heights], 1)
