"""Simulated captures by hand and on a stand, as observations files, and how a calibrated camera fares against them.

Simulate the corners of a board while a hand moves, by a camera that reads its rows one after the other.

A rolling shutter takes row v at time ((v + 0.5) / height - 0.5) of the readout, counted from the middle of the image. A
corner appears in the row that is read when its own image crosses it: an implicit equation, solved by iteration. Within
the exposure of its row the corner moves on; what is detected is its mean position, less precisely along the motion.
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from kcal import Board, CalibrationOptions, Camera, InputError, KcalError, Observations, calibrate_camera
from kcal.calibrate.camera.advice import reached
from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.calibrate.hybrid.fit import HybridFit
from kcal.lens import pixel_covariance
from kcal.lens.pose import Pose, rotation_from_vector
from kcal.sim.captures import (
    BoardLike,
    LensLike,
    PoseOptions,
    PrintedBoard,
    drawn_lens,
    sample_board_poses,
    true_corners,
)
from kcal.sim.truth import TruthLens
from scripts.shared.captures import BOARD, PAPER_BOARD, PRESCRIPTIONS, as_observations, error_at_infinity
from scripts.shared.page import Record

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


LENSES = ("webcam", "machine-vision", "surveillance")
FILL = 0.25, 0.8  # of the image by the board
# Squared distance that a normal vector of two components exceeds once in twenty times.
CHI2 = -2.0 * math.log(0.05)


class Simulated(NamedTuple):
    """One capture: the true lens, what was seen, and the truth about it."""

    lens: TruthLens
    seen: Observations
    truth: MovingCapture


def simulated(
    seed: int,
    views: int,
    sigma: float,
    by_hand: bool,
    *,
    max_roll: float = math.radians(25.0),
    stretch: float = 1.0,
    take: int = 0,
    bent: float = 0.0,
    share: float = 1.0,
    board: BoardLike | None = None,
    shifts: Tensor | None = None,
) -> Simulated:
    """Draw a lens, a printed board and views of it; lens and what is held follow from the seed in turn.

    Args:
        seed: of everything; the same seed has the same lens, board and poses by hand and on a stand.
        views: how many.
        sigma: noise of sharp corners, pixels.
        by_hand: whether the camera or the board is held by hand.
        max_roll: largest turn of the boards about their normals, radians.
        stretch: factor by which the images' rows were stretched; 1 leaves pixels square.
        take: another one has other poses, motions and noise, and the same lens and board.
        bent: meters by which the board bends about an axis of its own in each view (standard deviation).
        share: of the views in which it does; in the others it is stiff.
        board: with the corners of `BOARD`, in place of an ordinary print.
        shifts: (V, 2) or more, pixels by which a stabilizer shifts the image of each view.
    """
    lens = drawn_lens(PRESCRIPTIONS[LENSES[seed % len(LENSES)]], 1.0, seed, wander=1.0)
    hands = Hands(holds="camera" if seed // len(LENSES) % 2 else "board") if by_hand else None
    generator, options = torch.Generator().manual_seed(1000 + seed + 10**6 * take), PoseOptions(max_roll=max_roll)
    poses = sample_board_poses(quick(lens), BOARD, views, generator, fill=FILL, options=options)
    board = board or PrintedBoard(BOARD.columns, BOARD.rows, BOARD.square, seed)
    heights = bends(views, bent, share, torch.Generator().manual_seed(9000 + seed)) if bent else None
    truth = moving_capture(
        lens, poses, sigma=sigma, seed=1000 + seed + 10**6 * take, hands=hands, board=board, heights=heights
    )
    pixels = truth.pixels if shifts is None else truth.pixels + shifts[:views, None]
    seen = pixels.isfinite().all(-1) & lens.inside(pixels.nan_to_num(nan=-9.0))
    pixels = torch.where(seen[..., None], pixels, torch.nan)
    return Simulated(lens, stretched(pixels, truth.covariance, lens.size, stretch), truth)


def bends(views: int, size: float, share: float, generator: torch.Generator, board: Board = BOARD) -> Tensor:
    """(V, N) heights of a board that bends in some views: along one direction of its own, more on one side."""
    low, high = board.points[:, :2].amin(0), board.points[:, :2].amax(0)
    flat = (2.0 * board.points[:, :2] - low - high) / (high - low).max()
    angle, chosen = torch.rand(2, views, dtype=torch.float64, generator=generator)
    height, skewed = torch.randn(2, views, 1, dtype=torch.float64, generator=generator)
    across = torch.stack([torch.cos(math.pi * angle), torch.sin(math.pi * angle)], -1) @ flat.T
    count = max(1, round(share * views))
    return torch.where((chosen.argsort().argsort() < count)[:, None], size * height, 0.0) * (
        (1.0 - across**2) * (1.0 + 0.3 * skewed * across)
    )


def quick(lens: TruthLens) -> Camera:
    """The lens within some pixels, as a camera that draws poses a hundred times as fast."""
    width, height = lens.size
    x, y = (torch.linspace(0, extent - 1, 15, dtype=torch.float64) for extent in (width, height))
    pixels = torch.cartesian_prod(x, y)
    center = torch.tensor([0.5 * (width - 1), 0.5 * (height - 1)], dtype=torch.float64)
    rays, _ = lens.unproject(pixels)
    theta = torch.atan2(rays[:, :2].norm(dim=-1), rays[:, 2])
    powers = torch.stack([theta ** (2 * k + 1) for k in range(5)], -1)
    found = torch.linalg.lstsq(powers, (pixels - center).norm(dim=-1, keepdim=True)).solution[:, 0]
    focal, coefficients = float(found[0]), (found[1:] / found[0]).tolist()
    return Camera.build(
        focal=(focal, focal), center=tuple(center.tolist()), size=lens.size, coefficients=coefficients, model="fisheye4"
    )


def stretched(pixels: Tensor, covariance: Tensor, size: tuple[int, int], factor: float) -> Observations:
    """Corners (V, N, 2), NaN where not seen, and covariances of an image whose rows are stretched by a factor."""
    scale = torch.tensor([1.0, factor], dtype=torch.float64)
    height = round(size[1] * factor)
    # The edge of the image stays where it is, half a pixel before the first center.
    corners, spread = (pixels + 0.5) * scale - 0.5, covariance * scale[:, None] * scale
    return as_observations(corners, (size[0], height), covariance=spread)


class Shifted(NamedTuple):
    """A lens before a stabilizer that shifts its image by (2,) pixels."""

    lens: TruthLens
    by: Tensor

    @property
    def size(self) -> tuple[int, int]:
        """Of the image, pixels."""
        return self.lens.size

    def unproject(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """As a lens does."""
        return self.lens.unproject(pixels - self.by)


def against_truth(case: Simulated, options: CalibrationOptions, shifts: Iterable[Tensor] = ()) -> Record:
    """Calibrate, and compare with the true lens all over the image, at infinity; also in frames with these shifts."""
    try:
        result = calibrate_camera(case.seen, options)
        error = error_at_infinity(result.camera, case.lens)
        found = told(result) | figures(result.camera, case.seen, error.pixels, error.errors)
        frames = [error_at_infinity(result.camera, Shifted(case.lens, own)) for own in shifts]  # type: ignore[arg-type]
        if frames:
            inside = (figures(result.camera, case.seen, frame.pixels, frame.errors)["everywhere"] for frame in frames)
            found["frame"] = statistics.fmean(inside)
    except KcalError as refusal:
        return {"refused": str(refusal)}
    return found | {"rms": error.rms, "valid": error.valid}


def told(result: CameraCalibrationResult) -> Record:
    """What a result says of itself."""
    return {
        "noise": result.noise,
        "warnings": list(result.warnings),
        "tempering": None if result.hybrid is None else result.hybrid.tempering,
        "terms": [] if result.hybrid is None else terms(result.hybrid),
        "causes": causes(result),
    }


def causes(result: CameraCalibrationResult) -> list[str]:
    """Which causes a result names: a lens that moves, a board that bends, motion, or views that are unlike others."""
    names = {finding.name for finding in result.findings}
    named = {"lens": "moving-lens", "bending": "bending", "motion": "motion"}
    return [cause for cause, name in named.items() if name in names] + ["views"] * bool(result.rejected_views)


def terms(fit: HybridFit) -> list[str]:
    """What views were found to do."""
    readout = fit.readout
    found = {
        "motion": readout is not None and getattr(readout, "moves", True),
        "bending": getattr(readout, "bends", None) is not None,
        "corners": getattr(fit, "displaced", None) is not None,
    }
    return [name for name, here in found.items() if here]


def figures(camera: Camera, seen: Observations | None, pixels: Tensor, errors: Tensor) -> Record:
    """Shares of the image (rows, columns, 2) in which the truth is in the 95 % ellipse, and the RMS that σ predicts."""
    rows, columns = pixels.shape[:2]
    covariance = pixel_covariance(camera, pixels.reshape(-1, 2))
    off = errors.reshape(-1, 2)
    good = off.isfinite().all(-1) & covariance.isfinite().all(-1).all(-1)
    eye = torch.eye(2, dtype=torch.float64)
    distance = (off * torch.linalg.solve(torch.where(good[:, None, None], covariance, eye), off)).sum(-1)
    inside = (distance < CHI2)[good]
    within = torch.ones_like(inside) if seen is None else reached(seen, columns, rows).reshape(-1)[good]
    return {
        "inside": float(inside[within].double().mean()),
        "beyond": float(inside[~within].double().mean()),
        "everywhere": float(inside.double().mean()),
        "predicted": float(covariance[good].diagonal(dim1=-2, dim2=-1).sum(-1).mean().sqrt()),
    }
