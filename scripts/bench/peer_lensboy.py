"""lensboy on one training set, for comparison; runs in an interpreter that has lensboy and SciPy, without kcal.

    PYTHON scripts/bench/peer_lensboy.py problem.npz OPENCV14 | SPLINED11x8

Its own `calibrate_camera` with the board's warp; it has no weights of corners and rejects none here. Prints one line of
JSON: CPU seconds and sum(w² |r|²) with its count over held-out views, whose poses alone are solved again.
"""

from __future__ import annotations

import json
import sys
import time
from importlib.metadata import version
from typing import Any

import cv2
import lensboy  # type: ignore[import-not-found, unused-ignore]
import numpy as np
from scipy.optimize import least_squares


def main() -> None:
    with np.load(sys.argv[1]) as data:
        corners, weight, train, held = data["corners"], data["weight"], data["train"], data["held"]
        (width, height), (columns, rows) = data["image_size"].tolist(), data["board_size"].tolist()
        square, focal = float(data["square_m"]), float(data["focal"])
    board = np.stack([*np.meshgrid(np.arange(columns), np.arange(rows)), np.zeros((rows, columns))], -1).reshape(-1, 3)
    board = board * square
    size: Any = {"image_height": height, "image_width": width}
    if sys.argv[2] == "OPENCV14":
        lens = lensboy.OpenCVConfig(**size, included_distortion_coefficients=np.ones(14, bool))
    else:
        x, y = map(int, sys.argv[2].removeprefix("SPLINED").split("x"))
        lens = lensboy.PinholeSplinedConfig(**size, num_knots_x=x, num_knots_y=y)
    frames = [
        lensboy.Frame(target_point_indices=np.flatnonzero(w > 0), detected_points_in_image=view[w > 0])
        for view, w in zip(corners[train], weight[train], strict=True)
    ]
    cpu = time.process_time()
    found = lensboy.calibrate_camera(board, frames, lens, estimate_target_warp=True, outlier_threshold_stddevs=None)
    cpu = time.process_time() - cpu
    points = board if found.target_warp is None else found.target_warp.warp_target(board)

    total, count, middle = 0.0, 0, ((width - 1) / 2, (height - 1) / 2)
    for view, w in zip(corners[held], weight[held], strict=True):
        seen, pixels, weights = points[w > 0], view[w > 0], w[w > 0, None]

        def error(pose: Any, seen: Any = seen, pixels: Any = pixels, weights: Any = weights) -> Any:
            projected = found.camera_model.project_points(seen @ cv2.Rodrigues(pose[:3])[0].T + pose[3:])
            return (weights * np.nan_to_num(projected - pixels, nan=1e4, posinf=1e4, neginf=-1e4)).ravel()

        matrix = np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1.0]])
        starts = [
            cv2.solvePnP(seen, pixels, matrix, None, flags=flag) for flag in (cv2.SOLVEPNP_IPPE, cv2.SOLVEPNP_SQPNP)
        ]
        poses = [np.concatenate([turn.ravel(), shift.ravel()]) for good, turn, shift in starts if good]
        total += min(2.0 * least_squares(error, pose, x_scale="jac").cost for pose in poses)
        count += len(seen)
    print(json.dumps({"version": version("lensboy"), "cpu_s": cpu, "sum": total, "count": count}))


if __name__ == "__main__":
    main()
