"""Captures with one planted fault each, and clean ones, for `scripts.check.verdict`."""

from __future__ import annotations

import dataclasses
import math
import random
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal import Board, CalibrationOptions, Observations, View
from kcal.lens import rotation_from_vector
from kcal.lens.pose import Pose
from kcal.sim.captures import PoseOptions, TrueRig, drawn_lens, drawn_rig, sample_board_poses
from kcal.sim.truth import TruthLens
from scripts.shared.pair_poses import sample_pair_poses
from scripts.shared.prescriptions import PRESCRIPTIONS
from scripts.shared.traced import printed

FAULTS = ("model", "fronto-parallel", "warp", "blur", "unsynchronized", "pupil", "mirrored or mixed")
BOARD = Board(columns=9, rows=6, square=0.04)
_ROLLS = PoseOptions(max_roll=math.radians(90.0))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Planted:
    """A capture of one camera.

    Args:
        lens: the truth.
        observations: what kcal gets.
        options: as a user would give them.
        detail: what was planted.
    """

    lens: TruthLens
    observations: Observations
    options: CalibrationOptions
    detail: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlantedPair:
    """Captures of two cameras, each alone and of both together."""

    rig: TrueRig
    alone: tuple[Observations, Observations]
    pairs: tuple[Observations, Observations]
    detail: str


def observed(
    pixels: Tensor, size: tuple[int, int], spread: Tensor | None = None, names: list[str] | None = None
) -> Observations:
    """Corners (V, N, 2) as observations; `spread` (V,) is the stated noise of each view's corners, px."""
    views = []
    for i, view in enumerate(pixels.tolist()):
        corners = tuple(None if u != u else (u, v) for u, v in view)
        own = None if spread is None else float(spread[i]) ** 2
        covariance = None if own is None else tuple(None if c is None else (own, 0.0, own) for c in corners)
        views.append(View(name=names[i] if names else f"{i:03d}.png", pixels=corners, covariance=covariance))
    return Observations(board=BOARD, image_size=size, views=tuple(views))


def corners_of(lens: TruthLens, points: Tensor, poses: Sequence[tuple[Tensor, Tensor]], noise: Tensor) -> Tensor:
    """(V, N, 2) corners of a board whose corners truly are at `points`, with noise (V, N, 2); NaN outside the image."""
    seen = []
    for rotation, translation in poses:
        pixels, valid = lens.project(points @ rotation.T + translation)
        seen.append(torch.where(valid[:, None], pixels, torch.nan))
    noisy = torch.stack(seen) + noise
    return torch.where(lens.inside(noisy)[..., None], noisy, torch.nan)


def drawn(kind: str, seed: int) -> Planted | PlantedPair:
    """The capture of a seed: "clean", "clean pair", or one of the faults."""
    draw = random.Random(f"{kind} {seed}")
    generator = torch.Generator().manual_seed(seed)
    if kind in ("unsynchronized", "clean pair"):
        return _pair(kind, draw, seed, generator)
    views, sigma = draw.randint(18, 28), draw.uniform(0.05, 0.2)
    points, options, names = BOARD.points, CalibrationOptions(), None
    design, strength, wander, fill, tilt = "machine-vision", draw.uniform(0.5, 1.5), 0.3, (0.25, 0.8), 0.0
    detail = ""
    if kind == "clean":
        choice = draw.choice(["hybrid", "hybrid", "exact", "opencv8"])
        design = draw.choice(["machine-vision", "surveillance"]) if choice == "hybrid" else design
        if choice == "hybrid":
            points, wander = printed(points, seed), draw.uniform(0.1, 1.0)
        options = {"hybrid": options, "exact": CalibrationOptions(board="exact")}.get(
            choice, CalibrationOptions(model="opencv14")
        )
        wander = 0.0 if choice == "opencv8" else wander
        detail = f"{choice}, {design}"
    elif kind == "model":
        design = "webcam"
        options = CalibrationOptions(model=draw.choice(["opencv4", "opencv5"]))
        strength, wander, detail = draw.uniform(1.0, 3.0), 0.1, f"{design}, {options.model}"
    elif kind == "fronto-parallel":
        tilt = draw.uniform(0.5, 4.0)
        options = CalibrationOptions(model=draw.choice(["hybrid", "opencv5"]))
        detail = f"{tilt:.1f}°, {options.model}"
    elif kind == "warp":
        bend = draw.choice([-1.0, 1.0]) * draw.uniform(1.0, 4.0)
        points, about = _bent(points, 1e-3 * bend, draw.uniform(0.0, math.pi)), draw.choice(["exact", "opencv8"])
        options = CalibrationOptions(board="exact") if about == "exact" else CalibrationOptions(model="opencv8")
        detail = f"{bend:.1f} mm, {about}"
    elif kind == "pupil":
        design, wander, fill = "surveillance", 1.0, (0.4, 1.0)
        options = CalibrationOptions(model=draw.choice(["opencv8", "opencv14"]))
        detail = f"{options.model}"
    lens = drawn_lens(PRESCRIPTIONS[design], strength, seed, wander=wander)
    if kind == "pupil":
        # Lenses of large cameras: the pupil moves by millimeters, and the board is near.
        lens = drawn_lens(PRESCRIPTIONS[design], strength, seed, wander=wander, focal_mm=draw.uniform(4.0, 12.0))
    held = sample_board_poses(lens, BOARD, views, generator, fill=fill, options=_ROLLS)
    if kind == "fronto-parallel":
        held = [_parallel(pose, math.radians(tilt), generator) for pose in held]
    order = torch.randperm(views, generator=generator).tolist()
    held = [held[i] for i in order]
    noise = torch.randn(views, len(points), 2, dtype=torch.float64, generator=generator)
    spread = torch.full((views,), sigma, dtype=torch.float64)
    if kind == "blur":
        spread = torch.tensor([draw.uniform(0.8, 2.0) if draw.random() < 0.8 else sigma for _ in range(views)]).double()
        detail = f"σ {float(spread.median()):.2f} px"
    pixels = corners_of(lens, points, held, noise * spread[:, None, None])
    if kind == "mirrored or mixed":
        how = draw.choice(["mirrored", "some mirrored", "two boards"])
        detail = how
        grid = pixels.unflatten(1, (BOARD.rows, BOARD.columns))
        if how == "mirrored":
            grid = grid.flip(2)
        elif how == "some mirrored":
            some = torch.rand(views, generator=generator) < draw.uniform(0.2, 0.5)
            grid = torch.where(some[:, None, None, None], grid.flip(2), grid)
        else:
            stretch = draw.choice([-1.0, 1.0]) * draw.uniform(0.01, 0.03)
            other = points * torch.tensor([1.0 + stretch, 1.0, 1.0], dtype=torch.float64)
            some = torch.rand(views, generator=generator) < draw.uniform(0.3, 0.7)
            again = corners_of(lens, other, held, noise * spread[:, None, None])
            grid = torch.where(some[:, None, None], again, pixels).unflatten(1, (BOARD.rows, BOARD.columns))
            detail = f"two boards, {100 * stretch:.1f} %"
        pixels = grid.flatten(1, 2)
    stated = spread if kind == "blur" or draw.random() < 0.5 else None
    return Planted(lens=lens, observations=observed(pixels, lens.size, stated, names), options=options, detail=detail)


def _parallel(pose: Pose, tilt: float, generator: torch.Generator) -> Pose:
    """The board at its place, parallel to the image up to a tilt, rolled at random."""
    turn, towards = (math.pi * (2.0 * torch.rand(2, dtype=torch.float64, generator=generator) - 1.0)).tolist()
    axis = torch.tensor([tilt * math.cos(towards), tilt * math.sin(towards), 0.0], dtype=torch.float64)
    roll = torch.tensor([0.0, 0.0, 0.5 * turn], dtype=torch.float64)
    rotation = rotation_from_vector(axis) @ rotation_from_vector(roll)
    middle = BOARD.points.mean(0)
    return Pose(rotation, pose.rotation @ middle + pose.translation - rotation @ middle)


def _bent(points: Tensor, height: float, angle: float) -> Tensor:
    """The board bent to a cylinder whose middle is higher by `height` meters."""
    middle = points.mean(0)
    half = float((points - middle).norm(dim=-1).max())
    across = ((points - middle)[:, 0] * math.cos(angle) + (points - middle)[:, 1] * math.sin(angle)) / half
    return torch.cat([points[:, :2], height * (1.0 - across**2)[:, None]], 1)


def _pair(kind: str, draw: random.Random, seed: int, generator: torch.Generator) -> PlantedPair:
    """Both cameras calibrated alone; then pairs of a larger board, with or without motion between both exposures."""
    rig = drawn_rig(PRESCRIPTIONS["machine-vision"], 1.0, seed)
    sigma = draw.uniform(0.05, 0.15)
    alone = []
    for lens in (rig.left, rig.right):
        poses = sample_board_poses(lens, BOARD, 20, generator, fill=(0.25, 0.8), options=_ROLLS)
        noise = sigma * torch.randn(20, BOARD.corners, 2, dtype=torch.float64, generator=generator)
        alone.append(observed(corners_of(lens, printed(BOARD.points, seed), poses, noise), lens.size))
    large = BOARD.model_copy(update={"square": 0.3})
    poses = sample_pair_poses(rig, large, 16, generator, distance=(14.0, 25.0), options=PoseOptions())
    speed = draw.uniform(0.01, 0.05) if kind == "unsynchronized" else 0.0
    seen: list[list[Tensor]] = [[], []]
    for rotation, translation in poses:
        moved = speed * torch.randn(3, dtype=torch.float64, generator=generator)
        for c, lens in enumerate((rig.left, rig.right)):
            points = large.points @ rotation.T + translation + c * moved
            pixels, valid = lens.project(points if c == 0 else rig.right_from_left(points))
            noise = sigma * torch.randn(pixels.shape, dtype=torch.float64, generator=generator)
            noisy = pixels + noise
            seen[c].append(torch.where((valid & lens.inside(noisy))[:, None], noisy, torch.nan))
    pairs = [
        observed(torch.stack(side), lens.size).model_copy(update={"board": large})
        for side, lens in zip(seen, (rig.left, rig.right), strict=True)
    ]
    return PlantedPair(rig=rig, alone=(alone[0], alone[1]), pairs=(pairs[0], pairs[1]), detail=f"{1000 * speed:.0f} mm")
