"""One draw of the paper's experiment: both cameras calibrated with every model, rigs solved, seven points located."""

from __future__ import annotations

import json
import math
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from paper_site import KINDS, MARK_SIGMA, SURVEY_SIGMA, lenses, observe, paper_scene
from torch import Tensor

from kcal.calibrate.align import pose_alone
from kcal.calibrate.hybrid import HybridOptions, calibrate_hybrid
from kcal.calibrate.mono import CalibrationOptions, calibrate_camera
from kcal.calibrate.rig import JointOptions, solve_rig
from kcal.calibrate.rig_sources import Landmarks, RigData
from kcal.corners.observations import Observations
from kcal.errors import KcalError
from kcal.lens.camera import Camera
from kcal.locate.stereo import Triangulate
from kcal.sim.infinity import error_at_infinity
from kcal.sim.scene import DemoScene
from kcal.solve.lm import LMOptions

SIDES = ("left", "right")
# What the paper calls 14, 16, 18, 20, 20 (its second one), 22 and 24 parameters.
MODELS = {
    "14": "opencv14",
    "16": "ext16",
    "18": "ext18",
    "20": "ext20",
    "20b": "ext20b",
    "22": "ext22",
    "24": "ext24",
    "hybrid": "hybrid",
    "field": "field",
}
NAN = math.nan
DRAWS = 100  # of the marks' noise
FLAGS = cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL | cv2.CALIB_TILTED_MODEL


def run_seed(folder: Path, name: str, seed: int, views: int) -> dict[str, Any]:
    """Everything of one seed of one kind of camera; what is in the folder is not made again."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "result.json"
    known = json.loads(path.read_text()) if path.exists() else {}
    result: dict[str, Any] = {"name": name, "seed": seed, "spent": {}, "cameras": {}, "held_out": {}, "located": {}}
    result["failed"] = []
    result |= known
    spent = result["spent"]
    true = lenses(name, seed)
    for side, lens in true.items():
        if not all((folder / f"{side}.{who}.json").exists() for who in ("kcal", "opencv")):
            for stage, seconds in observe(folder, name, seed, side, lens, views).items():
                spent[stage] = spent.get(stage, 0.0) + seconds
    seen = {side: Observations.load(folder / f"{side}.kcal.json") for side in true}
    result["views"] = {side: len(observations.views) for side, observations in seen.items()}
    is_rig = name in KINDS
    scene = paper_scene(KINDS[name], seed) if is_rig else None
    for label, model in MODELS.items() if is_rig else [("14", MODELS["14"])]:
        if label in result["cameras"]:
            continue
        path.write_text(json.dumps(result))
        start = time.process_time()
        try:
            pair = {side: fit(seen[side], model) for side in true}
        except KcalError as error:
            result["failed"].append(f"{label}: {error}")
            result["cameras"][label] = {
                side: dict.fromkeys(("rms", "fx", "infinity", "infinity_max"), NAN) for side in true
            }
            if scene is not None:
                result["held_out"][label], result["located"][label] = NAN, nowhere(len(scene.targets.names))
            continue
        spent[f"calibrate, {label}"] = time.process_time() - start
        result["cameras"][label] = {side: describe(*pair[side], true[side]) for side in true}
        if scene is not None:
            start = time.process_time()
            try:
                result["held_out"][label] = held_out(seen, model)
            except KcalError as error:
                result["failed"].append(f"{label}, held-out views: {error}")
                result["held_out"][label] = NAN
            spent[f"held-out views, {label}"] = time.process_time() - start
            start = time.process_time()
            both = pair["left"][0], pair["right"][0]
            alone = located(scene, both, noise=False)["range_error"]
            result["located"][label] = located(scene, both) | {"lens_error": alone}
            spent[f"rig and positions, {label}"] = time.process_time() - start
    if "OpenCV" not in result["cameras"]:
        start = time.process_time()
        plain = {side: Observations.load(folder / f"{side}.opencv.json") for side in true}
        theirs = {side: opencv_camera(plain[side]) for side in true}
        spent["calibrate, OpenCV"] = time.process_time() - start
        result["cameras"]["OpenCV"] = {
            side: describe(as_camera(matrix, lens, plain[side]), rms, true[side])
            for side, (rms, matrix, lens) in theirs.items()
        }
        if scene is not None:
            alone = located_by_opencv(scene, theirs, noise=False)["range_error"]
            result["located"]["OpenCV"] = located_by_opencv(scene, theirs) | {"lens_error": alone}
    if scene is not None:
        pixels = scene.target_marks.true_left
        result["bound"], result["target_pixels"] = bound(scene), pixels.tolist()
        result["targets"] = scene.targets.enu.tolist()
    path.write_text(json.dumps(result))
    return result


def fit(seen: Observations, model: str) -> tuple[Camera, float]:
    """Calibrate with a model of `MODELS`.

    The hybrid is the paper's: a field on top of 20 coefficients. "hybrid" is what kcal returns, which is a parametric
    camera where held-out views do not say that the field is better; "field" has the field in any case. Drawn poses
    have no neighbours, so that every view may be held out for itself.
    """
    if model == "hybrid":
        found = calibrate_hybrid(seen, HybridOptions(models=("ext20",), groups="views")).calibration
    elif model == "field":
        found = calibrate_hybrid(
            seen, HybridOptions(models=("ext20",), groups="views", gate=False, rivals=())
        ).calibration
    else:
        found = calibrate_camera(seen, CalibrationOptions(model=model))
    return found.camera, found.rms


def describe(camera: Camera, rms: float, truth: Any) -> dict[str, float]:
    found = error_at_infinity(camera, truth)
    return {"rms": rms, "fx": float(camera.focal[0]), "infinity": found.rms, "infinity_max": found.maximum}


def held_out(seen: dict[str, Observations], model: str) -> float:
    """RMS of every third view, from a calibration on the others; its pose is solved with the camera as it is."""
    squares, count = 0.0, 0
    for observations in seen.values():
        names = list(observations.names)
        camera, _ = fit(observations.subset([n for i, n in enumerate(names) if i % 3]), model)
        board, pixels = observations.board.points, observations.subset(names[::3]).pixels()
        poses, _ = pose_alone(board, pixels, camera, LMOptions())
        seen_at, valid = camera.project(board @ poses.rotation.transpose(-1, -2) + poses.translation[:, None])
        some = torch.isfinite(pixels).all(-1)
        if bool((some & ~valid).any()):
            return math.inf  # a corner that the lens does not reach
        squares += float((seen_at - pixels)[some].square().sum())
        count += int(some.sum())
    return math.sqrt(squares / count)


# --- positions ---------------------------------------------------------------------------------------------------


def located(scene: DemoScene, cameras: tuple[Camera, Camera], noise: bool = True) -> dict[str, Any]:
    """Orient the cameras by the landmarks, and locate the seven points; without noise only the lenses are wrong."""
    points, left, right = oriented_by(scene, noise)
    landmarks = Landmarks(
        names=scene.landmarks.names,
        points=points,
        sigma=torch.full_like(points, SURVEY_SIGMA),
        pixels=torch.stack([left, right], 1),
        pixel_sigma=MARK_SIGMA,
    )
    # Nothing is left out: a lens model that contradicts the landmarks is to show it.
    solved = solve_rig(RigData(cameras=cameras, names=SIDES, landmarks=landmarks), JointOptions(reject=False))
    rig = solved.stereo()
    locate = Triangulate(rig, pixel_sigma=MARK_SIGMA)

    def place(left: Tensor, right: Tensor) -> Tensor:
        found = locate(left, right)
        enu = found.points @ solved.rotation[0] + solved.centre[0]
        return torch.where((found.status == 0)[..., None], enu, torch.nan)

    def project(enu: Tensor) -> tuple[Tensor, Tensor]:
        left, right, valid = rig((enu - solved.centre[0]) @ solved.rotation[0].T)
        return torch.where(valid[:, None], left, torch.nan), torch.where(valid[:, None], right, torch.nan)

    return judge(scene, place, project)


def nowhere(count: int) -> dict[str, Any]:
    """What is recorded where there is no camera."""
    lines = ("reprojection", "range_error", "lens_error", "position_error", "total_rms", "check_reprojection")
    return {name: [NAN] * count for name in lines} | {
        name: [[NAN] * 3] * count for name in ("marked", "exact", "integer")
    }


def oriented_by(scene: DemoScene, noise: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Places of the landmarks, and their pixels left and right, as surveyed and marked, or as they truly are."""
    marks = scene.landmark_marks
    if noise:
        return scene.surveyed(scene.landmarks).enu, marks.left, marks.right
    return scene.landmarks.enu, marks.true_left, marks.true_right


def judge(scene: DemoScene, place: Any, project: Any) -> dict[str, Any]:
    """Positions and reprojection errors of the seven points, and of the check points."""
    targets, marks = scene.targets.enu, scene.target_marks
    exact, marked = place(marks.true_left, marks.true_right), place(marks.left, marks.right)
    whole = place(marks.left.round(), marks.right.round())
    generator = scene.generator(-50)
    noise = MARK_SIGMA * torch.randn((2, DRAWS, *marks.left.shape), dtype=torch.float64, generator=generator)
    drawn = torch.stack([place(marks.true_left + a, marks.true_right + b) for a, b in zip(*noise, strict=True)])
    check = scene.check_marks
    return {
        "reprojection": pixel_errors(project(targets), (marks.true_left, marks.true_right)),
        "range_error": (exact.norm(dim=-1) - targets.norm(dim=-1)).tolist(),
        "position_error": (exact - targets).norm(dim=-1).tolist(),
        "total_rms": (drawn.norm(dim=-1) - targets.norm(dim=-1)).square().nanmean(0).sqrt().tolist(),
        "marked": marked.tolist(),
        "exact": exact.tolist(),
        "integer": whole.tolist(),
        "check_reprojection": pixel_errors(project(scene.surveyed(scene.checks).enu), (check.left, check.right)),
    }


def pixel_errors(seen: tuple[Tensor, Tensor], true: tuple[Tensor, Tensor]) -> list[float]:
    """The larger of the two cameras' errors for each point, pixels; NaN where a model has no pixel."""
    return torch.stack([(a - b).norm(dim=-1) for a, b in zip(seen, true, strict=True)]).amax(0).tolist()


def bound(scene: DemoScene) -> list[float]:
    """Standard deviation of each range that the marks' noise alone leaves, with the rig known exactly, metres."""
    points = scene.points_rig(scene.targets)
    columns = []
    for axis in torch.eye(3, dtype=torch.float64):
        step = 1e-5 * points.norm(dim=-1, keepdim=True) * axis
        ahead, behind = (torch.cat(scene.rig(points + sign * step)[:2], -1) for sign in (1, -1))
        columns.append((ahead - behind) / (2e-5 * points.norm(dim=-1, keepdim=True)))
    jacobian = torch.stack(columns, -1)
    covariance = torch.linalg.inv(jacobian.transpose(-1, -2) @ jacobian) * MARK_SIGMA**2
    sight = torch.nn.functional.normalize(points, dim=-1)
    return torch.einsum("ni,nij,nj->n", sight, covariance, sight).sqrt().tolist()


# --- OpenCV ------------------------------------------------------------------------------------------------------


def opencv_camera(seen: Observations) -> tuple[float, Any, Any]:
    board = [seen.board.points.float().numpy()] * len(seen.views)
    pixels = [view.float().numpy() for view in seen.pixels()]
    rms, matrix, lens, *_ = cv2.calibrateCamera(board, pixels, seen.image_size, None, None, flags=FLAGS)
    return float(rms), matrix, lens.ravel()[:14]


def as_camera(matrix: Any, lens: Any, seen: Observations) -> Camera:
    return Camera.build(
        focal=(matrix[0, 0], matrix[1, 1]),
        center=(matrix[0, 2], matrix[1, 2]),
        size=seen.image_size,
        coefficients=lens.tolist(),
        model="opencv14",
    )


def located_by_opencv(
    scene: DemoScene, cameras: dict[str, tuple[float, Any, Any]], noise: bool = True
) -> dict[str, Any]:
    """`solvePnP` on the landmarks, `undistortPoints` and `triangulatePoints`, as a user of OpenCV would."""
    points, *marks = oriented_by(scene, noise)
    surveyed, poses = points.numpy(), {}
    for side, pixels in zip(SIDES, marks, strict=True):
        _, matrix, lens = cameras[side]
        _, turn, shift = cv2.solvePnP(surveyed, pixels.numpy(), matrix, lens, flags=cv2.SOLVEPNP_SQPNP)
        poses[side] = cv2.solvePnPRefineLM(surveyed, pixels.numpy(), matrix, lens, turn, shift)
    projections = [np.hstack([cv2.Rodrigues(turn)[0], shift]) for turn, shift in poses.values()]

    def place(left: Tensor, right: Tensor) -> Tensor:
        plane = [
            cv2.undistortPoints(pixels.numpy()[:, None], cameras[side][1], cameras[side][2])[:, 0].T
            for side, pixels in zip(SIDES, (left, right), strict=True)
        ]
        homogeneous = cv2.triangulatePoints(projections[0], projections[1], plane[0], plane[1])
        return torch.from_numpy((homogeneous[:3] / homogeneous[3]).T.astype(float))

    def project(enu: Tensor) -> tuple[Tensor, Tensor]:
        pixels = [
            cv2.projectPoints(enu.numpy(), *poses[side], cameras[side][1], cameras[side][2])[0][:, 0] for side in SIDES
        ]
        return torch.from_numpy(pixels[0]), torch.from_numpy(pixels[1])

    return judge(scene, place, project)
