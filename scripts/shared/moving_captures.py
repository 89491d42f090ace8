"""Simulate the corners of a board while a hand moves, by a camera that reads its rows one after the other.

A rolling shutter takes row v at time ((v + 0.5) / height - 0.5) of the readout, counted from the middle of the image. A
corner appears in the row that is read when its own image crosses it: an implicit equation, solved by iteration. Within
the exposure of its row the corner moves on; what is detected is its mean position, less precisely along the motion.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.pose import Pose, rotation_from_vector
from kcal.sim.captures import BoardLike, LensLike, true_corners
from scripts.shared.captures import PAPER_BOARD

# Width of an edge in a sharp image, pixels (standard deviation). Where motion of length L widens it to s, an edge is
# located with a variance that grows by s over this: the information of a blurred step is proportional to 1 / s.
_SHARP = 0.7
_TREMORS = 3  # sinusoids along each axis
# Gauss-Legendre nodes and weights on (-1/2, 1/2): exact for motions of fifth order within an exposure.
_NODES, _SHARES = (-math.sqrt(0.15), 0.0, math.sqrt(0.15)), (5 / 18, 8 / 18, 5 / 18)
_ROUNDS, _SETTLED = 50, 1e-7  # pixels
_DRAWS = 50


@dataclass(frozen=True, kw_only=True)
class Hands:
    """How a hand moves while pictures are taken; what is drawn once for a capture is drawn evenly in its logarithm.

    Half the variance of rates and speeds is constant during a picture, half is tremor.

    Args:
        holds: "board": it turns about its middle. "camera": the board turns about the camera.
        readout: seconds from the first row to the last, smallest and largest of a capture.
        exposure: seconds of one row, likewise.
        turning: standard deviation of the rate along each axis, radians per second, likewise.
        speed: likewise of the translation, meters per second.
        tremor: Hz, smallest and largest of each sinusoid.
        most_blur: pixels. Pictures with more blur are taken again, as a photographer would; after fifty of them, the
            motion is slowed down.

    Raises:
        InputError: values that are not positive, or not ordered.
    """

    holds: Literal["board", "camera"] = "board"
    readout: tuple[float, float] = (0.010, 0.030)
    exposure: tuple[float, float] = (0.005, 0.020)
    turning: tuple[float, float] = (0.1, 1.0)
    speed: tuple[float, float] = (0.05, 0.3)
    tremor: tuple[float, float] = (2.0, 10.0)
    most_blur: float = 12.0

    def __post_init__(self) -> None:
        if self.holds not in ("board", "camera"):
            raise InputError(f"Hands: holds must be 'board' or 'camera', got {self.holds!r}")
        for name in ("readout", "exposure", "turning", "speed", "tremor"):
            low, high = getattr(self, name)
            if not 0 < low <= high < math.inf:
                raise InputError(f"Hands: {name} needs two positive numbers, the smaller first, got {(low, high)}")
        if not self.most_blur > 0:
            raise InputError(f"Hands: most_blur must be positive pixels, got {self.most_blur}")


class HandMotion(NamedTuple):
    """How one thing moves about a moment: turn (radians) and shift (meters), six axes.

    Attributes:
        drift: (6,) constant rates.
        swing: (K, 6) largest rates of sinusoids.
        frequency: (K, 6) Hz.
        phase: (K, 6) radians.
    """

    drift: Tensor
    swing: Tensor
    frequency: Tensor
    phase: Tensor

    def at(self, times: Tensor) -> Tensor:
        """(..., 6) turn vector and shift after times (...) in seconds; zero at 0.

        Example:
            >>> still = torch.zeros(1, 6, dtype=torch.float64)
            >>> steady = HandMotion(torch.ones(6, dtype=torch.float64), still, still + 1.0, still)
            >>> steady.at(torch.tensor(0.5))[0].item()
            0.5
        """
        circular = 2.0 * math.pi * self.frequency
        waves = torch.sin(circular * times[..., None, None] + self.phase) - torch.sin(self.phase)
        return self.drift * times[..., None] + (self.swing / circular * waves).sum(-2)

    def slowed(self, factor: float) -> HandMotion:
        """The same with all rates multiplied by a factor."""
        return self._replace(drift=factor * self.drift, swing=factor * self.swing)


class MovingCapture(NamedTuple):
    """Views of a moving board and the truth about them.

    Attributes:
        pixels: (V, N, 2) corners with noise, in the order of `board_points`.
        true_pixels: (V, N, 2) where they are in the image, without noise.
        covariance: (V, N, 2, 2) px² of the noise.
        blur: (V, N, 2) pixels by which each corner moves during its exposure.
        rotation: (V, 3, 3) cam_from_board when the middle row is read.
        translation: (V, 3) meters, likewise.
        readout: seconds.
        exposure: seconds.
        turning: radians per second along each axis, standard deviation.
        speed: meters per second, likewise.
    """

    pixels: Tensor
    true_pixels: Tensor
    covariance: Tensor
    blur: Tensor
    rotation: Tensor
    translation: Tensor
    readout: float
    exposure: float
    turning: float
    speed: float


def moving_capture(
    lens: LensLike,
    poses: Sequence[Pose],
    *,
    sigma: float,
    seed: int,
    hands: Hands | None = None,
    board: BoardLike = PAPER_BOARD,
    heights: Tensor | None = None,
) -> MovingCapture:
    """Simulate a capture by hand: rolling shutter, blur, and noise that is larger along the blur.

    Args:
        lens: true lens.
        poses: of the board when the middle of the image is read, as from `sample_board_poses`.
        sigma: noise of sharp corners in pixels along each axis.
        seed: of noise and motion. On a stand, the noise is that of the same seed before blur.
        hands: how the hand moves; None: board and camera are on stands.
        board: its size, or a `PrintedBoard`.
        heights: (V, N) meters by which its corners lie higher in each view; None: it is stiff.

    Raises:
        InputError: no poses, or a sigma that is negative.

    Example:
        >>> from kcal import Camera
        >>> lens = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480))
        >>> pose = Pose(torch.eye(3, dtype=torch.float64), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
        >>> still, moving = (moving_capture(lens, [pose], sigma=0.1, seed=3, hands=hands) for hands in (None, Hands()))
        >>> bool((moving.true_pixels - still.true_pixels).norm(dim=-1).max() > 0.1)
        True
    """
    if not poses or not 0 <= sigma < math.inf:
        raise InputError(
            f"{len(poses)} poses, sigma {sigma}: at least one, and pixels that are not negative, are needed"
        )
    rotation, translation = (torch.stack(parts) for parts in zip(*poses, strict=True))
    points = true_corners(board)
    if heights is not None:
        points = points + torch.nn.functional.pad(heights[..., None], (2, 0))
    placed = points @ rotation.transpose(-1, -2) + translation[:, None]
    noise = torch.randn((*placed.shape[:2], 2), dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    if hands is None:
        true, valid = lens.project(placed)
        true, blur = torch.where(valid[..., None], true, torch.nan), torch.zeros_like(true)
        readout = exposure = turning = speed = 0.0
    else:
        generator = torch.Generator().manual_seed(seed + 7_000_003)
        readout, exposure, turning, speed = (
            low * (high / low) ** float(torch.rand(1, dtype=torch.float64, generator=generator))
            for low, high in (hands.readout, hands.exposure, hands.turning, hands.speed)
        )
        seen = [_moving_view(lens, view, hands, (readout, exposure, turning, speed), generator) for view in placed]
        true, blur = (torch.stack(parts) for parts in zip(*seen, strict=True))
    root = noise_root(blur, sigma)
    return MovingCapture(
        true + (root @ noise[..., None])[..., 0],
        true, root @ root, blur, rotation, translation, readout, exposure, turning, speed,
    )  # fmt: skip


def _moving_view(
    lens: LensLike, points: Tensor, hands: Hands, drawn: tuple[float, float, float, float], generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """`rolling_corners` of a picture that is not too blurred, by readout, exposure, rate and speed of a capture."""
    readout, exposure, turning, speed = drawn
    middle = points.mean(0) if hands.holds == "board" else torch.zeros(3, dtype=torch.float64)
    motion = draw_motion(turning, speed, hands.tremor, generator)
    for draw in itertools.count():
        pixels, blur = rolling_corners(lens, points, motion, middle, readout, exposure)
        if not float(blur.norm(dim=-1).nan_to_num().max()) > hands.most_blur:
            break
        motion = draw_motion(turning, speed, hands.tremor, generator) if draw < _DRAWS else motion.slowed(0.5)
    return pixels, blur


def draw_motion(turning: float, speed: float, tremor: tuple[float, float], generator: torch.Generator) -> HandMotion:
    """Draw a motion whose rates have given standard deviations, half of their variance from tremor.

    Args:
        turning: radians per second along each axis.
        speed: meters per second along each axis.
        tremor: smallest and largest frequency, Hz.
        generator: source of the draw.
    """
    size = torch.tensor([turning] * 3 + [speed] * 3, dtype=torch.float64)
    normal = torch.randn((1 + _TREMORS, 6), dtype=torch.float64, generator=generator)
    even = torch.rand((2, _TREMORS, 6), dtype=torch.float64, generator=generator)
    return HandMotion(
        drift=math.sqrt(0.5) * size * normal[0],
        # A sinusoid of random phase has half the variance of its largest value.
        swing=size * normal[1:] / math.sqrt(_TREMORS),
        frequency=tremor[0] + (tremor[1] - tremor[0]) * even[0],
        phase=2.0 * math.pi * even[1],
    )


def rolling_corners(
    lens: LensLike, points: Tensor, motion: HandMotion, middle: Tensor, readout: float, exposure: float
) -> tuple[Tensor, Tensor]:
    """Find where points appear that move while a camera reads its rows.

    Args:
        lens: true lens.
        points: (N, 3) in the camera's frame when the middle of the image is read.
        motion: of the points.
        middle: (3,) about which they turn.
        readout: seconds from the first row's time to the last one's.
        exposure: seconds of each row.

    Returns:
        (N, 2) mean positions during the exposure of the row in which they lie, and (N, 2) how far they move meanwhile;
        NaN where the lens does not see a point.
    """
    nodes = torch.tensor([*_NODES, -0.5, 0.5], dtype=torch.float64) * exposure
    shares = torch.tensor(_SHARES, dtype=torch.float64)[:, None, None]

    def during(pixels: Tensor) -> tuple[Tensor, Tensor]:
        times = ((pixels[:, 1] + 0.5) / lens.size[1] - 0.5) * readout
        step = motion.at(times + nodes[:, None])
        turn = rotation_from_vector(step[..., :3])
        at, valid = lens.project((turn @ (points - middle)[..., None])[..., 0] + middle + step[..., 3:])
        at = torch.where(valid[..., None], at, torch.nan)
        return (shares * at[:-2]).sum(0), at[-1] - at[-2]

    pixels, blur = during(torch.full((len(points), 2), 0.5 * (lens.size[1] - 1), dtype=torch.float64))
    for _ in range(_ROUNDS):
        former = pixels
        pixels, blur = during(former)
        if not bool((pixels - former).abs().nan_to_num().amax() > _SETTLED):
            break
    return pixels, blur


def noise_root(blur: Tensor, sigma: float) -> Tensor:
    """Symmetric root (..., 2, 2) of the covariance of corners that move by `blur` (..., 2) pixels in the exposure.

    Example:
        >>> noise_root(torch.tensor([0.0, 0.0]).double(), 0.1).tolist()
        [[0.1, 0.0], [0.0, 0.1]]
    """
    length = torch.linalg.vector_norm(blur, dim=-1)[..., None, None]
    along = blur[..., :, None] * blur[..., None, :] / length.clamp_min(1e-12) ** 2
    # A box of length L has the variance L²/12; the noise's standard deviation grows with the root of the edge's width.
    growth = (1.0 + length**2 / (12.0 * _SHARP**2)) ** 0.25
    return sigma * (torch.eye(2, dtype=torch.float64) + (growth - 1.0) * along)
