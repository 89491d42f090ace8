"""Read a camera file with another program's own reader and project points with it; runs without kcal.

    PYTHON scripts/check/peer_cameras.py KIND PATH POINTS.npy PIXELS.npy

KIND is mrcal, ros, colmap or one of the writers mrcal-write and colmap-write, which read the file and write it anew at
the place of PIXELS.npy. `mrcal-diff` takes two files joined by a comma and writes a .npz with mrcal's difference of
them: with equal frames, and after its own turn.
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


def ros_pair(paths: str, points: Any) -> Any:
    """Rectified pixels of points of the left camera's frame in both cameras, (N, 4), by image_geometry."""
    from camera_calibration_parsers import readCalibration
    from image_geometry import StereoCameraModel  # type: ignore[import-not-found, unused-ignore]

    infos = [readCalibration(path)[1] for path in paths.split(",")]
    model = StereoCameraModel()
    model.fromCameraInfo(*infos)
    turned = points @ np.reshape(infos[0].R, (3, 3)).T
    return np.array([np.ravel(model.project3dToPixel(point)) for point in turned])


def colmap_camera(path: str) -> Any:
    import pycolmap  # type: ignore[import-not-found, unused-ignore]

    folder = Path(path).parent
    for name in ("images", "points3D", "rigs", "frames"):
        if path.endswith(".txt"):
            (folder / f"{name}.txt").write_text("")
        elif name not in ("rigs", "frames"):
            (folder / f"{name}.bin").write_bytes(b"\0" * 8)
    reconstruction = pycolmap.Reconstruction()
    if path.endswith(".txt"):
        reconstruction.read_text(str(folder))
    else:
        reconstruction.read_binary(str(folder))
    return reconstruction


def by_colmap(path: str, points: Any) -> Any:
    return next(iter(colmap_camera(path).cameras.values())).img_from_cam(points) - 0.5


def main() -> None:
    kind, path, points_path, output = sys.argv[1:]
    if kind == "mrcal-diff":
        import mrcal

        models = [mrcal.cameramodel(part) for part in path.split(",")]
        _, fixed, q, _ = mrcal.projection_diff(models, intrinsics_only=True, use_uncertainties=False)
        _, turned, _, motion = mrcal.projection_diff(models, use_uncertainties=False, focus_radius=1e6)
        np.savez(output, fixed=fixed, turned=turned, q=q, rotation=motion[:3])
        return
    if kind == "mrcal-write":
        import mrcal

        mrcal.cameramodel(path).write(output)
        return
    if kind == "colmap-write":
        write = colmap_camera(path)
        (write.write_text if path.endswith(".txt") else write.write_binary)(str(Path(output).parent))
        return
    points = np.load(points_path)
    np.save(output, {"mrcal": by_mrcal, "ros": by_ros, "ros-pair": ros_pair, "colmap": by_colmap}[kind](path, points))


if __name__ == "__main__":
    main()
