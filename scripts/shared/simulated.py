"""Simulated captures by hand and on a stand, as observations files, and how a calibrated camera fares against them."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from kcal import Board, Camera, KcalError, Observations
from kcal.calibrate.camera.advice import reached
from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.calibrate.hybrid.fit import HybridFit
from kcal.lens import pixel_covariance
from kcal.sim.captures import BoardLike, PoseOptions, PrintedBoard, drawn_lens, sample_board_poses
from kcal.sim.truth import TruthLens
from scripts.shared.infinity import error_at_infinity
from scripts.shared.moving_captures import Hands, MovingCapture, moving_capture
from scripts.shared.prescriptions import PRESCRIPTIONS
from scripts.shared.sections import Record
from scripts.shared.traced import BOARD, as_observations

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
