"""Time and accuracy of calibration against other solvers on simulated views.

KCAL_PEERS names an interpreter that has pyceres, KCAL_MRCAL one that has mrcal and cv2; else these are left out.
KCAL_OPENCV names one with another OpenCV than this one's.
Every solver runs in its own process, warmed up on a few views, and measures the processor time of the calibration
alone. kcal and OpenCV calibrate from nothing; Ceres and mrcal start from `cv2.initCameraMatrix2D` and the true tilts,
without which they keep flipped boards. The runs of all solvers alternate. RMS is recomputed from each solution alike. A
lens that folds between the corners is no lens: such a solution is marked, and does not count as the best.
"""

from __future__ import annotations

import functools
import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from scripts.shared.children import answer, interpreter
from scripts.shared.page import peak_megabytes, section, table, timed
from scripts.shared.views import (
    COLUMNS,
    MODELS,
    ROWS,
    SIZE,
    SQUARE,
    WEAK,
    flipped_views,
    image_error,
    observed,
    simulate,
    true_camera,
)

# Solutions whose relative excess of RMS is below this count as equally good.
SAME = 1e-4
COLUMN_NAMES = ("RMS px", "excess", "truth px", "flipped", "memory MB")


# Solvers: data, number of coefficients -> (fx fy cx cy, coefficients, rotations, translations, seconds).
def with_kcal(data: dict[str, np.ndarray], coefficients: int, weak: float | None = None) -> tuple[Any, ...]:
    from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera

    seen = observed(data["pixels"].tolist())
    options = CalibrationOptions(model=MODELS[coefficients], weak_prior=weak)
    result, seconds = timed(calibrate_camera, seen, options)
    vector = result.camera.params.detach().numpy()
    poses = result.cam_from_board_rotation.numpy(), result.cam_from_board_translation.numpy()
    return vector[:4], vector[5:], *poses, seconds


def with_opencv(data: dict[str, np.ndarray], coefficients: int) -> tuple[Any, ...]:
    import cv2

    cv2.setNumThreads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    rich = cv2.CALIB_RATIONAL_MODEL
    flags = {5: 0, 8: rich, 14: rich | cv2.CALIB_THIN_PRISM_MODEL | cv2.CALIB_TILTED_MODEL}[coefficients]
    boards = [data["board"].astype(np.float32)] * len(data["pixels"])
    corners = [view.astype(np.float32)[:, None] for view in data["pixels"]]
    solve: Any = cv2.calibrateCamera
    (_, matrix, lens, turns, shifts), seconds = timed(
        solve, boards, corners, SIZE, None, None, flags=flags, criteria=(3, 100, 1e-10)
    )
    rotation = np.array([cv2.Rodrigues(turn)[0] for turn in turns])
    pinhole = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    return pinhole, lens.ravel()[:coefficients], rotation, np.array(shifts).reshape(-1, 3), seconds


def good_start(data: dict[str, np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Fx fy cx cy and poses (rotation vector, translation), of the two tilts the one next to the truth."""
    import cv2

    corners = [view.astype(np.float32)[:, None] for view in data["pixels"]]
    matrix = cv2.initCameraMatrix2D([data["board"].astype(np.float32)] * len(corners), corners, SIZE)
    poses = []
    for view, truth in zip(data["pixels"], data["rotation"], strict=True):
        _, turns, shifts, _ = cv2.solvePnPGeneric(data["board"], view[:, None], matrix, None, flags=cv2.SOLVEPNP_IPPE)
        best = max(range(len(turns)), key=lambda i: np.trace(truth.T @ cv2.Rodrigues(turns[i])[0]))
        poses.append(np.concatenate([turns[best].ravel(), shifts[best].ravel()]))
    return matrix[[0, 1, 0, 1], [0, 1, 2, 2]], poses


def with_mrcal(data: dict[str, np.ndarray], coefficients: int) -> tuple[Any, ...]:
    import cv2
    import mrcal

    from scripts.bench.peer_mrcal import problem

    count = len(data["pixels"])
    pinhole, poses = good_start(data)
    lens = np.random.default_rng(0).uniform(-1e-6, 1e-6, coefficients)
    lens[5:] *= 1e-3
    intrinsics, frames = np.concatenate([pinhole, lens])[None], np.array(poses)
    seen = np.ones((count, ROWS, COLUMNS, 3))
    seen[..., :2] = data["pixels"].reshape(count, ROWS, COLUMNS, 2)
    index = np.stack([np.arange(count), np.zeros(count), -np.ones(count)], 1).astype(np.int32)
    _, seconds = timed(
        mrcal.optimize, **problem(intrinsics, None, frames, seen, index), lensmodel=f"LENSMODEL_OPENCV{coefficients}",
        imagersizes=np.array([SIZE], np.int32), calibration_object_spacing=SQUARE, do_apply_outlier_rejection=False,
        do_optimize_calobject_warp=False, do_apply_regularization=False,
    )  # fmt: skip
    rotation = np.array([cv2.Rodrigues(frame[:3])[0] for frame in frames])
    return intrinsics[0, :4], intrinsics[0, 4:], rotation, frames[:, 3:], seconds


def with_ceres(data: dict[str, np.ndarray], coefficients: int) -> tuple[Any, ...]:
    import cv2
    import pyceres

    class View(pyceres.CostFunction):
        def __init__(self, pixels: np.ndarray) -> None:
            super().__init__()
            self.pixels = pixels
            self.set_num_residuals(pixels.size)
            self.set_parameter_block_sizes([4 + coefficients, 6])

        def Evaluate(self, blocks: Any, residuals: Any, jacobians: Any) -> bool:
            (fx, fy, cx, cy, *lens), pose = blocks
            matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
            full = np.array([*lens, *[0.0] * (14 - coefficients)])
            image, derivative = cv2.projectPoints(data["board"], pose[:3], pose[3:], matrix, full)
            residuals[:] = (image[:, 0] - self.pixels).ravel()
            for k, columns in enumerate((slice(6, 10 + coefficients), slice(0, 6))):
                if jacobians is not None and jacobians[k] is not None:
                    jacobians[k][:] = derivative[:, columns].ravel()
            return True

    pinhole, poses = good_start(data)
    shared = np.concatenate([pinhole, np.zeros(coefficients)])
    start = time.process_time()
    problem, costs = pyceres.Problem(), [View(view) for view in data["pixels"]]
    for cost, pose in zip(costs, poses, strict=True):
        problem.add_residual_block(cost, None, [shared, pose])
    options = pyceres.SolverOptions()
    options.linear_solver_type = pyceres.LinearSolverType.SPARSE_SCHUR
    options.num_threads, options.max_num_iterations, options.minimizer_progress_to_stdout = 1, 200, False
    options.function_tolerance = options.gradient_tolerance = options.parameter_tolerance = 1e-12
    pyceres.solve(options, problem, pyceres.SolverSummary())
    seconds = time.process_time() - start
    rotation = np.array([cv2.Rodrigues(pose[:3])[0] for pose in poses])
    return shared[:4], shared[4:], rotation, np.array(poses)[:, 3:], seconds


SOLVERS: dict[str, Any] = {
    "kcal": with_kcal,
    "kcal, weak prior": functools.partial(with_kcal, weak=WEAK),
    "OpenCV": with_opencv,
    "Ceres": with_ceres,
    "mrcal": with_mrcal,
}
# The models that each of them has; 5 coefficients have no use for the weak prior.
KNOWN = {"kcal": (5, 8, 14), "kcal, weak prior": (8, 14), "OpenCV": (5, 8, 14), "Ceres": (5, 8, 14), "mrcal": (5, 8)}
PYTHON = {"Ceres": "peers", "mrcal": "mrcal"}


def work(name: str, path: str, coefficients: int) -> None:
    """In a process of its own: solve once and print the outcome."""
    if name.startswith("kcal"):
        import torch

        torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    data = dict(np.load(path))
    # What is loaded at the first call only is not counted.
    SOLVERS[name]({key: values if key == "board" else values[:8] for key, values in data.items()}, 5)
    pinhole, lens, rotation, translation, seconds = SOLVERS[name](data, coefficients)
    peak = peak_megabytes()
    arrays = {"pinhole": pinhole, "lens": lens, "rotation": rotation, "translation": translation}
    np.savez(path.replace(".npz", f".{name}.npz"), **arrays)
    print(json.dumps({"seconds": seconds, "megabytes": peak}))


def judge(data: dict[str, np.ndarray], solution: dict[str, np.ndarray], coefficients: int) -> dict[str, Any]:
    """RMS, flipped views and whether the lens is one, by the same measure for all."""
    import torch

    from kcal.lens.camera import Camera
    from kcal.lens.model import LensModel
    from kcal.lens.projection import project_components

    model = LensModel.named(MODELS[coefficients])
    parameters = torch.tensor(np.concatenate([solution["pinhole"], [0.0], solution["lens"]]))[None]
    rotation, translation = torch.tensor(solution["rotation"]), torch.tensor(solution["translation"])
    points = rotation @ torch.tensor(data["board"]).T + translation[..., None]
    seen = project_components(points, parameters, model)
    error = seen.pixels.transpose(-1, -2) - torch.tensor(data["pixels"])
    flipped = flipped_views(solution["rotation"], data["rotation"])
    # A pole or fold shows on the way from the axis to the outermost corner.
    radius = float((points[:, :2] / points[:, 2:]).norm(dim=1).max())
    r, turns = torch.linspace(0, radius, 400).double(), torch.linspace(0, 2 * np.pi, 25).double()[:-1]
    ring = torch.stack([torch.outer(r, turns.cos()), torch.outer(r, turns.sin()), torch.ones(400, 24).double()])
    regular = bool(project_components(ring.flatten(1), parameters[0], model).regular.all())
    rms = float(error.square().sum(-1).mean().sqrt())
    found, truth = Camera(parameters[0], size=SIZE, model=model), true_camera()
    distance = image_error(found, truth)
    return {"rms": rms, "flipped": int(flipped.sum()), "regular": regular, "truth": distance}


def run(name: str, path: Path, coefficients: int, timeout: float) -> dict[str, Any]:
    peer = PYTHON.get(name, "opencv" if name == "OpenCV" else "")
    python = (interpreter(peer) if peer else "") or sys.executable
    code = f"from scripts.bench.solver import work; work({name!r}, {str(path)!r}, {coefficients})"
    return answer(python, "-c", code, timeout=timeout)


def compare(views: int, coefficients: int, repeats: int, timeout: float) -> Iterator[list[Any]]:
    """Rows of the table for one problem."""
    able = [name for name in SOLVERS if name not in PYTHON or interpreter(PYTHON[name])]
    names = [name for name in able if coefficients in KNOWN[name]]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "views.npz"
        data = simulate(views)
        np.savez(path, **data)  # type: ignore[arg-type]
        runs: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
        for _ in range(repeats):
            for name in names:
                if not any("failed" in one for one in runs[name]):
                    runs[name].append(run(name, path, coefficients, timeout))
        judged = {
            name: judge(data, dict(np.load(path.with_suffix(f".{name}.npz"))), coefficients)
            for name in names
            if "failed" not in runs[name][-1]
        }
    best = min((one["rms"] for one in judged.values() if one["regular"]), default=float("nan"))
    own = {name: [one.get("seconds", float("nan")) for one in runs[name]] for name in names if name.startswith("kcal")}
    for name in names:
        mine = ("kcal",) if coefficients == 5 else ("kcal", "kcal, weak prior")
        if name not in judged:
            yield [views, name, runs[name][-1]["failed"], *[""] * (len(mine) + len(COLUMN_NAMES))]
            continue
        seconds = [one["seconds"] for one in runs[name]]
        cells = []
        for way in mine:
            ratios = [a / b for a, b in zip(own.get(way, []), seconds, strict=False)]
            shown = ratios and not name.startswith("kcal")
            cells.append(f"{statistics.median(ratios):.2f}" if shown else "")
        one = judged[name]
        excess = f"{one['rms'] / best - 1:+.1e}" if one["regular"] else "folds"
        if one["regular"] and one["rms"] / best - 1 <= SAME:
            excess = "best"
        memory = max(entry["megabytes"] for entry in runs[name])
        yield [
            views, name, f"{1e3 * statistics.median(seconds):.0f}", *cells, f"{one['rms']:.6f}", excess,
            f"{one['truth']:.2f}", one["flipped"], f"{memory:.0f}",
        ]  # fmt: skip


def _registered(coefficients: int) -> None:
    @section("solver.md", f"{coefficients} coefficients", views=(15,), repeats=1)
    def solvers(views: tuple[int, ...] = (15, 50, 200, 800), repeats: int = 3, timeout: float = 60.0) -> Iterator[str]:
        ratios = ["kcal / this"] if coefficients == 5 else ["kcal / this", "kcal, weak prior / this"]
        rows = (cells for count in views for cells in compare(count, coefficients, repeats, timeout))
        return table(["views", "solver", "ms", *ratios, *COLUMN_NAMES], rows)


for _count in (5, 8, 14):
    _registered(_count)
