"""mrcal on many cameras at once, for comparison; runs in an interpreter that has mrcal, without kcal.

    /usr/bin/python3 scripts/bench/peer_mrcal_many.py problem.npz

The stages are those of mrcal-calibrate-cameras with LENSMODEL_OPENCV8: a stereographic seed, its refinement, the lens,
and with the board's warp. Prints one line of JSON: CPU seconds, peak megabytes, and centers (C, 3) and rotations
(C, 3, 3) cam_from_first.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import mrcal  # type: ignore[import-not-found, unused-ignore]
import numpy as np

_LENS = "LENSMODEL_OPENCV8"


def main() -> None:
    sys.path.append(str(Path(__file__).parents[2]))
    from scripts.bench.peer_mrcal import problem, seeded
    from scripts.shared.page import peak_megabytes

    with np.load(sys.argv[1]) as data:
        corners, size, (columns, rows) = data["corners"], data["image_size"].astype(np.int32), data["board_size"]
        square, focal = float(data["square_m"]), float(data["focal"])
    moments, cameras = corners.shape[:2]
    frame, camera = (a.ravel() for a in np.meshgrid(np.arange(moments), np.arange(cameras), indexing="ij"))
    whole = np.isfinite(corners).all((-2, -1)).ravel()
    index = np.stack([frame, camera, camera - 1], -1).astype(np.int32)[whole]
    seen = np.ones((len(index), rows, columns, 3))
    seen[..., :2] = corners.reshape(-1, rows, columns, 2)[whole]
    common = {
        "imagersizes": np.repeat(size[None], cameras, 0), "calibration_object_spacing": square,
        "do_apply_outlier_rejection": False,
    }  # fmt: skip
    cpu = time.process_time()
    intrinsics, extrinsics, frames = seeded(seen, index, focal, common, (False, True))
    small = (np.random.default_rng(0).random((cameras, mrcal.lensmodel_num_params(_LENS) - 4)) - 0.5) * 2e-6
    intrinsics, warp = np.concatenate([intrinsics, small], 1), np.zeros(2)
    for warped in (False, True):
        mrcal.optimize(
            **problem(intrinsics, extrinsics, frames, seen, index), lensmodel=_LENS,
            calobject_warp=warp if warped else None, do_optimize_intrinsics_core=True,
            do_optimize_intrinsics_distortions=True, do_optimize_calobject_warp=warped, do_apply_regularization=True,
            **common,
        )  # fmt: skip
    cpu = time.process_time() - cpu
    turns = np.concatenate([np.eye(3)[None], mrcal.R_from_r(extrinsics[:, :3])])
    shift = np.concatenate([np.zeros((1, 3)), extrinsics[:, 3:]])
    center = -np.einsum("cji,cj->ci", turns, shift)
    print(json.dumps({"cpu": cpu, "peak": peak_megabytes(), "center": center.tolist(), "rotation": turns.tolist()}))


if __name__ == "__main__":
    main()
