"""mrcal's splined lens on one training set, for comparison; runs in an interpreter that has mrcal, without kcal.

    /usr/bin/python3 scripts/bench/peer_mrcal.py problem.npz SPLINED13x9 [FIELD_OF_VIEW]

The stages are those of mrcal-calibrate-cameras: a stereographic seed from a rough focal length, its refinement, the
lens with mrcal's regularization, and with the board's warp. Prints one line of JSON: seconds of all that (process CPU),
the lens with its name, and sum(w² |r|²) with its count over held-out views, whose poses alone are solved again. The
splines cover FIELD_OF_VIEW degrees, 170 if it is left out. If it is given, the focal length and the middle of the image
are held as they are: a narrow lens does not determine them as a stereographic one, and they run away.
"""

from __future__ import annotations

import json
import sys
import time
from importlib.metadata import version
from typing import Any

import mrcal  # type: ignore[import-not-found, unused-ignore]
import numpy as np


def arrays(corners: Any, weight: Any, shape: tuple[int, int]) -> tuple[Any, Any]:
    """Mrcal's observations (V, H, W, 3) and indices of frame and camera."""
    seen = np.zeros((len(corners), *shape, 3))
    seen[..., :2] = np.nan_to_num(corners).reshape(len(corners), *shape, 2)
    seen[..., 2] = np.where(weight > 0, weight, -1.0).reshape(len(corners), *shape)
    index = np.zeros((len(corners), 3), np.int32)
    index[:, 0], index[:, 2] = np.arange(len(corners)), -1
    return seen, index


def problem(intrinsics: Any, extrinsics: Any, frames: Any, seen: Any, index: Any) -> dict[str, Any]:
    """What `mrcal.optimize` starts from, by its names of poses in 2.5, or else those before."""
    new = "rt_ref_frame" in mrcal.optimize.__doc__
    return {
        "intrinsics": intrinsics, "rt_cam_ref" if new else "extrinsics_rt_fromref": extrinsics,
        "rt_ref_frame" if new else "frames_rt_toref": frames, "points": None, "observations_board": seen,
        "indices_frame_camintrinsics_camextrinsics": index, "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None,
    }  # fmt: skip


def seeded(seen: Any, index: Any, focal: float, common: dict[str, Any], frees: tuple[bool, ...]) -> tuple[Any, ...]:
    """A stereographic seed, refined with the core of the lens held and free: intrinsics, extrinsics and frames."""
    intrinsics, extrinsics, frames = mrcal.seed_stereographic(
        imagersizes=common["imagersizes"], focal_estimate=focal, indices_frame_camera=index[:, :2].copy(),
        observations=seen, object_spacing=common["calibration_object_spacing"],
    )  # fmt: skip
    for free in frees:
        mrcal.optimize(
            **problem(intrinsics, extrinsics, frames, seen, index), lensmodel="LENSMODEL_STEREOGRAPHIC",
            do_optimize_intrinsics_core=free, do_optimize_intrinsics_distortions=False,
            do_optimize_calobject_warp=False, do_apply_regularization=False, **common,
        )  # fmt: skip
    return intrinsics, extrinsics, frames


def main() -> None:
    with np.load(sys.argv[1]) as data:
        corners, weight, train, held = data["corners"], data["weight"], data["train"], data["held"]
        size, (columns, rows) = data["image_size"].astype(np.int32)[None], data["board_size"].tolist()
        square, focal = float(data["square_m"]), float(data["focal"])
    nx, ny = sys.argv[2].removeprefix("SPLINED").split("x")
    field = sys.argv[3] if len(sys.argv) > 3 else "170"
    lens = f"LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx={nx}_Ny={ny}_fov_x_deg={field}"
    common = {"imagersizes": size, "calibration_object_spacing": square, "do_apply_outlier_rejection": False}
    seen, index = arrays(corners[train], weight[train], (rows, columns))

    cpu = time.process_time()
    frees = (False,) if len(sys.argv) > 3 else (False, True)
    intrinsics, _, frames = seeded(seen, index, focal, common, frees)
    small = (np.random.default_rng(0).random(mrcal.lensmodel_num_params(lens) - 4) - 0.5) * 2e-6
    intrinsics, warp = np.concatenate([intrinsics, small[None]], 1), np.zeros(2)

    def optimize(frames: Any, seen: Any, index: Any, what: dict[str, bool]) -> None:
        mrcal.optimize(
            **problem(intrinsics, None, frames, seen, index), lensmodel=lens, do_optimize_intrinsics_core=False,
            **what, **common,
        )  # fmt: skip

    optimize(frames, seen, index, {"do_optimize_calobject_warp": False, "do_apply_regularization": True})
    common["calobject_warp"] = warp
    optimize(frames, seen, index, {"do_optimize_calobject_warp": True, "do_apply_regularization": True})
    out: dict[str, Any] = {"cpu_s": time.process_time() - cpu}
    out |= {
        "version": version("mrcal"),
        "lens": lens,
        "intrinsics": intrinsics[0].tolist(),
        "knots": mrcal.knots_for_splined_models(lens)[0].tolist(),
    }

    if len(held):
        seen, index = arrays(corners[held], weight[held], (rows, columns))
        poses = mrcal.estimate_monocular_calobject_poses_Rt_tocam(
            index[:, :2].copy(), seen, square, [(lens, intrinsics[0])]
        )
        frames = mrcal.rt_from_Rt(poses)
        fixed = {"do_optimize_intrinsics_distortions": False, "do_optimize_calobject_warp": False}
        optimize(frames, seen, index, {**fixed, "do_apply_regularization": False})
        board = mrcal.ref_calibration_object(columns, rows, square, calobject_warp=warp)
        errors = mrcal.project(mrcal.transform_point_rt(frames[:, None, None], board), lens, intrinsics[0])
        errors = errors - seen[..., :2]
        used = seen[..., 2] > 0
        out |= {"sum": float(((errors**2).sum(-1) * seen[..., 2] ** 2)[used].sum()), "count": int(used.sum())}
    print(json.dumps(out))


if __name__ == "__main__":
    main()
