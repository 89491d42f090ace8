"""What the experiment's cameras are worth on its site: rigs oriented by landmarks, points located, errors split up.

The range error that cameras and rig make (*calibration*) is not one number: each survey and each set of the landmarks'
marks gives another, and a single one may be near zero at 5 km by luck. So every pair of cameras is oriented `DRAWS`
times with fresh noise, the same for all models, and once without any, which leaves the *lenses* alone.

The paper's rig for `reproduce.py`: its three kinds of lenses, its printed board, images, and the corners in them.

Entrance pupils move as those of real lenses of that size. Images are rendered through a ray-traced lens, get noise, a
gamma and JPEG's losses, and go through kcal's detector and through OpenCV's; nothing that is calibrated ever sees the
truth.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from kcal import Board, Camera, KcalError, Localizer, RigData, RigOptions, solve_rig
from kcal.corners.detect import detect_board, view_of
from kcal.corners.observations import Failure, Observations, View
from kcal.sim.captures import PrintedBoard, drawn_rig, sample_board_poses
from kcal.sim.scene import FOCAL_MM, DemoScene, NamedPoints, Places, RenderOptions, SceneMarks, render_board
from scripts.shared.captures import PAPER_BOARD, PRESCRIPTIONS
from scripts.shared.long_range import landmarks_of, range_sigma

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


SIDES = ("left", "right")
DRAWS, MARKINGS = 10, 10  # of the landmarks' noise, and of the seven points' marks for each of them
FAR, MARGIN = 5000.0, 70.0  # meters; pixels from the edge, about where the outermost targets are
NAN = math.nan
# Pixels to places, and places (ENU) to pixels; NaN where there is none.
Rig = tuple[Callable[[Tensor, Tensor], Tensor], Callable[[Tensor], tuple[Tensor, Tensor]]]
# From places of landmarks and their pixels, left and right.
Orient = Callable[[Tensor, Tensor, Tensor], Rig]


def judge(scene: PaperScene, orient: Orient) -> dict[str, Any]:
    """Errors of the seven points, of far points all over the image, and of the check points; meters and pixels."""
    targets, marks, far = scene.targets.enu, scene.target_marks, far_points(scene)
    true = marks.true_left, marks.true_right
    truth, seen = scene.landmarks.enu, scene.landmark_marks
    generator = scene.generator(-60)
    survey = SURVEY_SIGMA * torch.randn((DRAWS, *truth.shape), dtype=torch.float64, generator=generator)
    noise = MARK_SIGMA * torch.randn((DRAWS, 2, len(truth), 2), dtype=torch.float64, generator=generator)
    marking = MARK_SIGMA * torch.randn(
        (2, DRAWS, MARKINGS, *targets[:, :2].shape), dtype=torch.float64, generator=generator
    )

    place, _ = orient(truth, seen.true_left, seen.true_right)
    found: dict[str, Any] = {
        "lens": ranges(place(*true), targets).tolist(),
        "range_error": [],
        "position_error": [],
        "reprojection": [],
        "far": [],
    }
    total = torch.zeros(len(targets), dtype=torch.float64)
    for draw in range(DRAWS):
        place, project = orient(truth + survey[draw], seen.true_left + noise[draw, 0], seen.true_right + noise[draw, 1])
        exact = place(*true)
        found["range_error"].append(ranges(exact, targets).tolist())
        found["position_error"].append((exact - targets).norm(dim=-1).tolist())
        found["reprojection"].append(pixel_errors(project(targets), true))
        found["far"].append(rms_or_inf(ranges(place(*far.pixels), far.enu)))
        total += ranges(place(true[0] + marking[0, draw], true[1] + marking[1, draw]), targets).square().sum(0)
        if draw == 0:
            check = scene.check_marks
            found["check_reprojection"] = pixel_errors(
                project(scene.surveyed(scene.checks).enu), (check.left, check.right)
            )
            found["marked"] = place(marks.left, marks.right).tolist()
            found["integer"] = place(marks.left.round(), marks.right.round()).tolist()
    return found | {"total": (total / (DRAWS * MARKINGS)).sqrt().tolist()}


def nowhere(scene: PaperScene) -> dict[str, Any]:
    """What is recorded where there is no camera, or no rig."""
    none, places = [NAN] * len(scene.targets.names), [[NAN] * 3] * len(scene.targets.names)
    each = {name: [none] * DRAWS for name in ("range_error", "position_error", "reprojection")}
    checks = [NAN] * len(scene.checks.names)
    return each | {
        "lens": none, "far": [math.inf] * DRAWS, "total": none, "marked": places,
        "integer": places, "check_reprojection": checks,
    }  # fmt: skip


class Far(NamedTuple):
    """Points 5 km away all over what both cameras see, and their true pixels, left and right."""

    enu: Tensor
    pixels: tuple[Tensor, Tensor]


def far_points(scene: DemoScene) -> Far:
    width, height = scene.rig.left.size
    u = torch.linspace(MARGIN, width - 1 - MARGIN, 13, dtype=torch.float64)
    v = torch.linspace(MARGIN, height - 1 - MARGIN, 7, dtype=torch.float64)
    rays, known = scene.rig.left.unproject(torch.stack(torch.meshgrid(u, v, indexing="xy"), -1).reshape(-1, 2))
    points = FAR * torch.nn.functional.normalize(rays, dim=-1)
    pixels, valid = scene.rig(points)
    (left, right), valid = pixels.unbind(-2), valid.all(-1)
    size = torch.tensor([width, height], dtype=torch.float64) - 1.0 - MARGIN
    both = known & valid & ((right >= MARGIN) & (right <= size)).all(-1)
    return Far(points[both] @ scene.enu_from_rig.T, (left[both], right[both]))


def ranges(found: Tensor, true: Tensor) -> Tensor:
    """Errors of the distance from the left camera's true place, meters."""
    return found.norm(dim=-1) - true.norm(dim=-1)


def rms_or_inf(errors: Tensor) -> float:
    """RMS; infinite if a point has no place."""
    return float(torch.nan_to_num(errors.square(), nan=math.inf).mean().sqrt())


def pixel_errors(seen: tuple[Tensor, Tensor], true: tuple[Tensor, Tensor]) -> list[float]:
    """The larger of the two cameras' errors for each point, pixels; NaN where a model has no pixel."""
    return torch.stack([(a - b).norm(dim=-1) for a, b in zip(seen, true, strict=True)]).amax(0).tolist()


def bound(scene: DemoScene) -> list[float]:
    """Standard deviation of each range that the marks' noise alone leaves, with the rig known exactly, meters."""
    return range_sigma(scene.rig, scene.points_rig(scene.targets), MARK_SIGMA).tolist()


def by_kcal(cameras: tuple[Camera, Camera], points: Tensor, left: Tensor, right: Tensor) -> Rig:
    """`solve_rig` on the landmarks, and `Localizer`."""
    landmarks = landmarks_of(points, torch.stack([left, right], 1), SURVEY_SIGMA, MARK_SIGMA)
    try:
        # Nothing is left out: a lens model that contradicts the landmarks is to show it.
        # The simulated light goes straight.
        options = RigOptions(reject=False, refraction=0.0, refraction_sigma=0.0)
        solved = solve_rig(RigData(cameras=cameras, names=SIDES, landmarks=landmarks), options)
    except (KcalError, RuntimeError):
        return lost
    rig = solved.stereo()
    locate = Localizer(rig, pixel_sigma=MARK_SIGMA)

    def place(left: Tensor, right: Tensor) -> Tensor:
        found = locate(left, right)
        # Also where the parallax is below three sigma.
        known = (found.inverse_range > 0)[..., None]
        points = found.bearing / torch.where(known, found.inverse_range[..., None], 1.0)
        return torch.where(known, points @ solved.rotation[0] + solved.center[0], torch.nan)

    def project(enu: Tensor) -> tuple[Tensor, Tensor]:
        # By the lenses, not the rig: a pixel outside the image is one too.
        points = (enu - solved.center[0]) @ solved.rotation[0].T
        left, known = rig.left.project(points)
        right, also = rig.right.project(rig.right_from_left(points))
        valid = (known & also)[:, None]
        return torch.where(valid, left, torch.nan), torch.where(valid, right, torch.nan)

    return place, project


# A rig that could not be solved locates nothing.
lost: Rig = (
    lambda left, right: left.new_full((*left.shape[:-1], 3), NAN),
    lambda enu: (enu.new_full((len(enu), 2), NAN), enu.new_full((len(enu), 2), NAN)),
)


def dense(pixels: Tensor) -> Any:
    """As OpenCV takes points: it refuses one camera's pixels as a view of those of all cameras."""
    return np.ascontiguousarray(pixels.numpy())


def by_opencv(cameras: dict[str, tuple[Any, Any]], points: Tensor, left: Tensor, right: Tensor) -> Rig:
    """`solvePnP` on the landmarks, `undistortPoints` and `triangulatePoints`, as a user of OpenCV would.

    Args:
        cameras: matrix and distortion of both sides.
        points: of landmarks.
        left: their pixels in the left image.
        right: and in the right one.
    """
    surveyed, poses = points.numpy(), {}
    for side, pixels in zip(SIDES, (left, right), strict=True):
        (matrix, lens), marks = cameras[side], dense(pixels)
        _, turn, shift = cv2.solvePnP(surveyed, marks, matrix, lens, flags=cv2.SOLVEPNP_SQPNP)
        poses[side] = cv2.solvePnPRefineLM(surveyed, marks, matrix, lens, turn, shift)
    projections = [np.hstack([cv2.Rodrigues(turn)[0], shift]) for turn, shift in poses.values()]

    def place(left: Tensor, right: Tensor) -> Tensor:
        plane = [
            cv2.undistortPoints(dense(pixels.reshape(-1, 1, 2)), *cameras[side])[:, 0].T
            for side, pixels in zip(SIDES, (left, right), strict=True)
        ]
        homogeneous = cv2.triangulatePoints(projections[0], projections[1], plane[0], plane[1])
        enu = (homogeneous[:3] / homogeneous[3]).T
        ahead = enu @ projections[0][2, :3] + projections[0][2, 3] > 0
        return torch.from_numpy(np.where(ahead[:, None], enu, NAN)).reshape(*left.shape[:-1], 3)

    def project(enu: Tensor) -> tuple[Tensor, Tensor]:
        pixels = [cv2.projectPoints(enu.numpy(), *poses[side], *cameras[side])[0][:, 0] for side in SIDES]
        return torch.from_numpy(pixels[0]), torch.from_numpy(pixels[1])

    return place, project
