"""Read a camera file with another program's own reader and project points with it; runs without kcal.

    PYTHON scripts/check/peer_cameras.py KIND PATH POINTS.npy PIXELS.npy

KIND is mrcal, ros or colmap. `mrcal-solve` calibrates a camera from simulated corners, writes it to PATH, and to
PIXELS.npy its standard deviations, without mrcal's regularization and with noise by degrees of freedom. `mrcal-diff`
takes two files joined by a comma and writes a .npz with mrcal's difference of them: with equal frames, and after its
own turn.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np


def by_mrcal(path: str, points: Any) -> Any:
    import mrcal  # type: ignore[import-not-found, unused-ignore]

    return mrcal.project(points, *mrcal.cameramodel(path).intrinsics())


def by_ros(path: str, points: Any) -> Any:
    import cv2
    from camera_calibration_parsers import readCalibration  # type: ignore[import-not-found, unused-ignore]

    _, info = readCalibration(path)
    matrix, lens, zero = np.reshape(info.K, (3, 3)), np.array(info.D), np.zeros(3)
    if info.distortion_model == "equidistant":
        return cv2.fisheye.projectPoints(points[:, None], zero, zero, matrix, lens)[0][:, 0]
    return cv2.projectPoints(points, zero, zero, matrix, lens)[0][:, 0]


def by_colmap(path: str, points: Any) -> Any:
    import pycolmap  # type: ignore[import-not-found, unused-ignore]

    for name in ("images", "points3D", "rigs", "frames"):
        Path(path).with_name(f"{name}.txt").write_text("")
    reconstruction = pycolmap.Reconstruction()
    reconstruction.read_text(str(Path(path).parent))
    return next(iter(reconstruction.cameras.values())).img_from_cam(points) - 0.5


def mrcal_solve(path: str) -> Any:
    import mrcal

    sys.path.append(str(Path(__file__).parents[2]))
    from scripts.bench.peer_mrcal import problem

    draw, lens = np.random.default_rng(0), "LENSMODEL_OPENCV5"
    intrinsics = np.array([[1000.0, 1001, 640, 360, -0.1, 0.02, 1e-3, -5e-4, 0.003]])
    frames = np.concatenate(
        [draw.uniform(-0.4, 0.4, (12, 3)), draw.uniform([-0.5, -0.3, 0.8], [0.2, 0, 1.4], (12, 3))], 1
    )
    corners = np.ones((12, 7, 7, 3))
    for corner, frame in zip(corners, frames, strict=True):
        board = mrcal.transform_point_rt(frame, mrcal.ref_calibration_object(7, 7, 0.05))
        corner[..., :2] = mrcal.project(board, lens, intrinsics[0]) + draw.normal(0, 0.2, (7, 7, 2))
    index = np.stack([np.arange(12), np.zeros(12), -np.ones(12)], 1).astype(np.int32)
    inputs = {
        **problem(intrinsics, np.zeros((0, 6)), frames, corners, index), "lensmodel": lens,
        "imagersizes": np.array([[1280, 720]], dtype=np.int32), "calobject_warp": np.zeros(2),
        "do_optimize_intrinsics_core": True, "do_optimize_intrinsics_distortions": True, "do_optimize_extrinsics": True,
        "do_optimize_frames": True, "do_optimize_calobject_warp": True, "calibration_object_spacing": 0.05,
        "do_apply_regularization": True, "verbose": False,
    }  # fmt: skip
    mrcal.optimize(**inputs, do_apply_outlier_rejection=False)
    mrcal.cameramodel(optimization_inputs=inputs, icam_intrinsics=0).write(path)
    _, x, slopes, _ = mrcal.optimizer_callback(**inputs)
    seen = corners.size // 3 * 2
    slopes = slopes.toarray()[:seen]
    unpacked = np.eye(slopes.shape[1])
    mrcal.unpack_state(unpacked, **inputs)
    covariance = unpacked @ np.linalg.inv(slopes.T @ slopes) @ unpacked.T
    return np.sqrt(np.diag(covariance)[:9] * np.square(x[:seen]).sum() / (seen - len(covariance)))


def main() -> None:
    kind, path, points_path, output = sys.argv[1:]
    if kind == "mrcal-diff":
        import mrcal

        models = [mrcal.cameramodel(part) for part in path.split(",")]
        _, fixed, q, _ = mrcal.projection_diff(models, intrinsics_only=True, use_uncertainties=False)
        _, turned, _, motion = mrcal.projection_diff(models, use_uncertainties=False, focus_radius=1e6)
        np.savez(output, fixed=fixed, turned=turned, q=q, rotation=motion[:3])
        return
    if kind == "mrcal-solve":
        np.save(output, mrcal_solve(path))
        return
    points = np.load(points_path)
    np.save(output, {"mrcal": by_mrcal, "ros": by_ros, "colmap": by_colmap}[kind](path, points))


if __name__ == "__main__":
    main()
