"""The paper's rig for `reproduce.py`: its three kinds of lenses, its printed board, images, and the corners in them.

Entrance pupils move as those of real lenses of that size. Images are rendered through a ray-traced lens, get noise, a
gamma and JPEG's losses, and go through kcal's detector and through OpenCV's; nothing that is calibrated ever sees the
truth.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch

from kcal.corners.board import Board
from kcal.corners.detect import detect_board, view_of
from kcal.corners.observations import Failure, Observations, View
from kcal.sim.captures import PrintedBoard, drawn_rig, sample_board_poses
from kcal.sim.scene import FOCAL_MM, DemoScene, NamedPoints, Places, RenderOptions, SceneMarks, render_board
from scripts.shared.captures import PAPER_BOARD
from scripts.shared.prescriptions import PRESCRIPTIONS

BOARD = Board(columns=PAPER_BOARD.columns, rows=PAPER_BOARD.rows, square=PAPER_BOARD.square)
QUALITY = 90  # of JPEG
MARK_SIGMA, SURVEY_SIGMA = 0.05, 0.02  # pixels, meters
# What a small noisy camera and what a good one makes of the same scene.
LOOKS = {
    "cctv": RenderOptions(blur=1.0, noise=4.0, vignetting=0.3, gamma=2.2),
    "vision": RenderOptions(blur=0.7, noise=1.5, vignetting=0.1),
}
CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE


# Surveyed too, but used for checks only; as `DemoScene.landmarks_at`.
_CHECKS = (
    ("stake", 200.0, 5.0, -13.0),
    ("trough", 300.0, 22.0, -10.0),
    ("gable", 550.0, -29.0, 14.0),
    ("lamp", 800.0, -1.0, 22.0),
    ("crane", 1300.0, 16.0, 55.0),
    ("cairn", 2400.0, -16.0, 100.0),
)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PaperScene(DemoScene):
    """The demonstration's site with points to check a rig, surveyed too and used for nothing else."""

    checks_at: Places = _CHECKS

    @property
    def checks(self) -> NamedPoints:
        """Points to check the rig with, where they truly are."""
        return self.places(self.checks_at)

    @property
    def check_marks(self) -> SceneMarks:
        """The check points marked in both images, with the scene's noise."""
        return self.marked(self.checks, -3)


class Kind(NamedTuple):
    """A kind of camera: lens, how badly it is put together, its size, its look, and what it sees of the site's field.

    Its size sets how far the entrance pupil moves.
    """

    title: str
    lens: str
    strength: float
    focal_mm: float = FOCAL_MM
    look: str = "cctv"
    field: float = 1.0


KINDS = {
    "glass": Kind("wide glass lens, poorly centered", "surveillance", 3.0),
    "plastic": Kind("plastic aspheres", "webcam", 1.0, focal_mm=2.8, field=0.7),
    "vision": Kind("machine vision lens", "machine-vision", 1.0, look="vision", field=0.88),
}


def paper_scene(kind: Kind, seed: int) -> PaperScene:
    """The site of one draw: its own lenses, print of the board, survey and marks."""
    plain = PaperScene()

    def seen(places: Places) -> Places:
        return tuple((label, meters, kind.field * bearing, up) for label, meters, bearing, up in places)

    return dataclasses.replace(
        plain,
        seed=seed,
        rig=drawn_rig(PRESCRIPTIONS[kind.lens], kind.strength, 100 + seed, focal_mm=kind.focal_mm, wander=1.0),
        near_board=PrintedBoard(*PAPER_BOARD, seed),
        render=LOOKS[kind.look],
        mark_sigma=MARK_SIGMA,
        survey_sigma=SURVEY_SIGMA,
        targets_at=seen(plain.targets_at),
        landmarks_at=seen(plain.landmarks_at),
        checks_at=seen(plain.checks_at),
    )


def observe(folder: Path, name: str, scene: DemoScene, side: str, views: int) -> None:
    """Render, spoil and search the images of one camera; the corners go to files."""
    lens, board = getattr(scene.rig, side), scene.near_board
    # Streams of their own for poses and noise, whatever else was drawn.
    generator = torch.Generator().manual_seed(1_000_003 * (scene.seed + 1) + 17 * len(name) + (side == "right"))
    poses = sample_board_poses(lens, board, views, generator, fill=(0.25, 0.8))
    found: dict[str, list[View]] = {"kcal": [], "opencv": []}
    failures: dict[str, list[Failure]] = {"kcal": [], "opencv": []}
    for number, pose in enumerate(poses):
        light = render_board(lens, pose, board, scene.render, generator)
        packed = cv2.imencode(".jpg", light.numpy(), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
        image = np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
        label = f"view-{number:02d}"
        detection = detect_board(image, BOARD)
        if detection.pixels is None:
            failures["kcal"].append(Failure(name=label, reason=detection.reason))
        else:
            found["kcal"].append(view_of(detection, label))
        seen, corners = cv2.findChessboardCorners(image, (BOARD.columns, BOARD.rows), flags=CLASSIC)
        if seen:
            corners = cv2.cornerSubPix(image, corners, (11, 11), (-1, -1), (3, 30, 1e-3))
            pixels = tuple(map(tuple, corners.reshape(-1, 2).astype(float).tolist()))
            found["opencv"].append(View(name=label, pixels=pixels))
        else:
            failures["opencv"].append(Failure(name=label, reason="not found"))
    for who in found:
        Observations(
            board=BOARD,
            image_size=lens.size,
            refinement="erf" if who == "kcal" else "opencv",
            views=tuple(found[who]),
            failures=tuple(failures[who]),
        ).save(folder / f"{side}.{who}.json")
