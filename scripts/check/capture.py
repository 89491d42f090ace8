"""Guided photography of a board against views at random: how many views give the same camera.

Each seed has a lens with five coefficients of its own, 1280 x 720, and a board of 9 x 6 corners 25 mm apart. Frames are
rendered, with noise and a little blur, and corners are detected in them. *Random*: 20 views drawn by
`kcal.sim.captures.sample_board_poses`: over the whole image, near and far, tilted and rolled. *Guided*: the first four
views and each next one as `kcal capture` asks for them, held by a person: off by 5 % of the distance across and by 10 %
along, by 8 degrees of tilt and 10 degrees of roll. A view that is not seen whole is held again.

Guided capture goes on until its σ is that of the 20 random views (points at infinity, RMS over the image; both as kcal
predicts it), or to 20 views. True errors are those of points at infinity after the best-fit rotation. Seeds below 100
are for tuning.
"""

from __future__ import annotations

import math
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kcal import Board, Camera, Observations, View, calibrate_camera
from kcal.calibrate.camera.advice import NextView, far_sigma
from kcal.capture.session import CaptureOptions, CaptureSession
from kcal.corners.detect import detect_board, view_of
from kcal.lens import rotation_from_vector
from kcal.lens.pose import Pose
from kcal.sim.captures import BoardSize, sample_board_poses
from kcal.sim.scene import RenderOptions, render_board
from scripts.shared.page import Lines
from scripts.shared.sections import NOT_KEPT, Kept, Record, section

BOARD = Board(columns=9, rows=6, square=0.025)
PRINT = BoardSize(BOARD.columns, BOARD.rows, BOARD.square)
SIZE, RANDOM = (1280, 720), 20
ACROSS, ALONG, TILT, ROLL = 0.05, 0.10, math.radians(8.0), math.radians(10.0)


def lens(seed: int) -> Camera:
    """A webcam of no particular make."""
    u = torch.randn(7, generator=torch.Generator().manual_seed(9000 + seed)).tolist()
    return Camera.build(
        focal=(950 + 60 * u[0],) * 2,
        center=(639.5 + 10 * u[1], 359.5 + 10 * u[2]),
        size=SIZE,
        coefficients=[-0.15 + 0.05 * u[3], 0.05 + 0.02 * u[4], 4e-4 * u[5], 4e-4 * u[6], 0.0],
        model="opencv5",
    )


def held(wanted: NextView, generator: torch.Generator) -> Pose:
    """The view as a person holds the board."""
    u = torch.randn(6, generator=generator, dtype=torch.float64)
    turn = rotation_from_vector(torch.tensor([TILT, TILT, ROLL], dtype=torch.float64) * u[:3])
    middle = 0.5 * (BOARD.points.amin(0) + BOARD.points.amax(0))
    center = wanted.rotation @ middle + wanted.translation
    distance = float(center.norm())
    center = center * (1.0 + ALONG * float(u[3])) + ACROSS * distance * torch.cat([u[4:], u.new_zeros(1)])
    rotation = turn @ wanted.rotation
    return Pose(rotation, center - rotation @ middle)


def true_error(found: Camera, truth: Camera) -> float:
    """RMS error of points at infinity over the image along an axis, after the best-fit rotation, pixels."""
    pixels = truth.grid(33, 19).reshape(-1, 2)
    there, here = truth.unproject(pixels)[0], found.unproject(pixels)[0]
    u, _, vh = torch.linalg.svd(there.T @ here)
    return float(((found.project(there @ (u @ vh))[0] - pixels).square().sum(-1).mean() / 2).sqrt())


def at_random(truth: Camera, seed: int) -> tuple[float, float]:
    """σ and true error of 20 random views."""
    generator = torch.Generator().manual_seed(100 + seed)
    views: list[View] = []
    for i, pose in enumerate(sample_board_poses(truth, PRINT, RANDOM, generator)):
        found = detect_board(frame(truth, pose, generator), BOARD)
        if found.pixels is not None:
            views.append(view_of(found, str(i)))
    camera = calibrate_camera(Observations(board=BOARD, image_size=SIZE, views=tuple(views))).camera
    return far_sigma(camera), true_error(camera, truth)


def frame(truth: Camera, pose: Pose, generator: torch.Generator) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """A rendered frame."""
    return np.asarray(render_board(truth, pose, PRINT, RenderOptions(), generator).numpy(), np.uint8)


def guided(truth: Camera, goal: float, seed: int) -> list[dict[str, float]]:
    """σ and true error after each calibration, until the goal."""
    generator = torch.Generator().manual_seed(200 + seed)
    out: list[dict[str, float]] = []
    with tempfile.TemporaryDirectory() as folder:
        session = CaptureSession(Path(folder) / "x.obs.json", BOARD, CaptureOptions(until=goal, most=RANDOM))
        # The first suggestion needs a frame, to know the image's size.
        session.offer(np.full((SIZE[1], SIZE[0]), 90, np.uint8), "dark", moving=False)
        attempt = 0
        while not session.finished:
            session.think()
            if session.result is not None and (not out or out[-1]["views"] < session.views):
                error = true_error(session.result.camera, truth)
                out.append({"views": session.views, "sigma": session.sigma, "error": error})
                continue
            if session.suggestion is None or attempt > 3 * RANDOM:
                break
            attempt += 1
            pose = held(session.suggestion, generator)
            if seen_whole(truth, pose):
                session.offer(frame(truth, pose, generator), f"{attempt}.png", moving=False)
    return out


def seen_whole(truth: Camera, pose: Pose) -> bool:
    """All corners are inside the image, with a margin for the outer squares."""
    pixels, valid = truth.project(BOARD.points @ pose.rotation.T + pose.translation)
    inside: Tensor = (pixels > 25) & (pixels < torch.tensor(SIZE) - 26)
    return bool((inside.all(-1) & valid).all())


def both(seed: int) -> Record:
    """σ and true error at random and guided."""
    truth, start = lens(seed), time.process_time()
    random = at_random(truth, seed)
    return {"random": random, "guided": guided(truth, random[0], seed), "cpu_s": time.process_time() - start}


@section("ordinary.md", "capture", seeds=range(300, 301))
def guidance(kept: Kept = NOT_KEPT, seeds: range = range(300, 308)) -> Lines:
    """One row for each seed, and the means."""
    records = kept.records([(seed,) for seed in seeds], both)
    yield ["seed", "σ of 20 random views, px", "true error, px", "guided views to this σ", "true error then, px"]
    views, ratios = [], []
    for record in sorted(records, key=lambda r: r["key"]):
        last, (sigma, error) = record["guided"][-1], record["random"]
        reached = last["sigma"] <= sigma
        views.append(last["views"])
        ratios.append(last["error"] / error)
        count = f"{last['views']:.0f}" if reached else f"not in {last['views']:.0f} ({last['sigma']:.3f} px)"
        yield [record["key"][0], f"{sigma:.4f}", f"{error:.4f}", count, f"{last['error']:.4f}"]
    ratio = math.exp(sum(map(math.log, ratios)) / len(ratios))
    median = sorted(views)[len(views) // 2]
    yield ["all", "", "", f"median {median:.0f}", f"{ratio:.2f} of random (geometric mean)"]
