"""Time and accuracy of calibration against other solvers on simulated views; a section of docs/measured/solver.md.

    python -m scripts.bench.solver                          all sizes and models, three runs each
    python -m scripts.bench.solver --views 15 50 --coefficients 5 14 --repeats 1
    KCAL_PEERS=/path/to/env/bin/python python -m scripts.bench.solver    Ceres too, from an environment with pyceres
    KCAL_MRCAL=/usr/bin/python3 python -m scripts.bench.solver           mrcal too, from one with mrcal and cv2

Every solver runs in its own process, warmed up on a few views, and measures the processor time of the calibration
alone. kcal and OpenCV calibrate from nothing; Ceres and mrcal start from `cv2.initCameraMatrix2D` and the true tilts,
without which they keep flipped boards. The runs of all solvers alternate. RMS is recomputed from each solution alike. A
lens that folds between the corners is no lens: such a solution is marked, and does not count as the best.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from scripts.shared.memory import peak_megabytes
from scripts.shared.page import table, write_section
from scripts.shared.timing import row, show
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
# Sections of the page, one for each number of coefficients; 20 have no peer and are printed only.
SECTIONS = {5: "5 coefficients", 8: "8 coefficients", 14: "14 coefficients"}
COLUMN_NAMES = ("RMS px", "excess", "truth px", "flipped", "memory MB")


# Solvers: data, number of coefficients -> (fx fy cx cy, coefficients, rotations, translations, seconds).
def with_kcal(data: dict[str, np.ndarray], coefficients: int, weak: float | None = None) -> tuple[Any, ...]:
    from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera

    seen = observed(data["pixels"].tolist())
    start = time.process_time()
    result = calibrate_camera(seen, CalibrationOptions(model=MODELS[coefficients], weak_prior=weak))
    seconds = time.process_time() - start
    vector = result.camera.params.detach().numpy()
    poses = result.cam_from_board_rotation.numpy(), result.cam_from_board_translation.numpy()
    return vector[:4], vector[5:], *poses, seconds


def with_weak_prior(data: dict[str, np.ndarray], coefficients: int) -> tuple[Any, ...]:
    return with_kcal(data, coefficients, WEAK)


def with_opencv(data: dict[str, np.ndarray], coefficients: int) -> tuple[Any, ...]:
    import cv2

    cv2.setNumThreads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    rich = cv2.CALIB_RATIONAL_MODEL
    flags = {5: 0, 8: rich, 14: rich | cv2.CALIB_THIN_PRISM_MODEL | cv2.CALIB_TILTED_MODEL}[coefficients]
    boards = [data["board"].astype(np.float32)] * len(data["pixels"])
    corners = [view.astype(np.float32)[:, None] for view in data["pixels"]]
    start = time.process_time()
    _, matrix, lens, turns, shifts = cv2.calibrateCamera(
        boards, corners, SIZE, None, None, flags=flags, criteria=(3, 100, 1e-10)
    )
    seconds = time.process_time() - start
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

    count = len(data["pixels"])
    pinhole, poses = good_start(data)
    lens = np.random.default_rng(0).uniform(-1e-6, 1e-6, coefficients)
    lens[5:] *= 1e-3
    intrinsics, frames = np.concatenate([pinhole, lens])[None], np.array(poses)
    seen = np.ones((count, ROWS, COLUMNS, 3))
    seen[..., :2] = data["pixels"].reshape(count, ROWS, COLUMNS, 2)
    index = np.stack([np.arange(count), np.zeros(count), -np.ones(count)], 1).astype(np.int32)
    start = time.process_time()
    mrcal.optimize(
        intrinsics=intrinsics,
        extrinsics_rt_fromref=None,
        frames_rt_toref=frames,
        points=None,
        observations_board=seen,
        indices_frame_camintrinsics_camextrinsics=index,
        observations_point=None,
        indices_point_camintrinsics_camextrinsics=None,
        lensmodel=f"LENSMODEL_OPENCV{coefficients}",
        imagersizes=np.array([SIZE], np.int32),
        calibration_object_spacing=SQUARE,
        do_apply_outlier_rejection=False,
        do_optimize_calobject_warp=False,
        do_apply_regularization=False,
    )
    seconds = time.process_time() - start
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


SOLVERS = {
    "kcal": with_kcal,
    "kcal, weak prior": with_weak_prior,
    "OpenCV": with_opencv,
    "Ceres": with_ceres,
    "mrcal": with_mrcal,
}
# The models that each of them has; 5 coefficients have no use for the weak prior.
KNOWN = {"kcal": (5, 8, 14, 20), "kcal, weak prior": (8, 14, 20), "OpenCV": (5, 8, 14), "Ceres": (5, 8, 14)} | {
    "mrcal": (5, 8)
}
PYTHON = {"Ceres": "KCAL_PEERS", "mrcal": "KCAL_MRCAL"}


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
    python = os.environ[PYTHON[name]] if name in PYTHON else sys.executable
    command = [python, "-m", "scripts.bench.solver", "--work", name, str(path), str(coefficients)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=True)
    except subprocess.TimeoutExpired:
        return {"failed": f"> {timeout:.0f} s"}
    except subprocess.CalledProcessError as error:
        return {"failed": error.stderr.strip().splitlines()[-1][:60]}
    found: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return found


def compare(views: int, coefficients: int, arguments: argparse.Namespace) -> tuple[list[list[Any]], dict[str, float]]:
    """Rows of the table for one problem, and the median seconds of each solver."""
    names = [name for name in arguments.solvers if coefficients in KNOWN[name]]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "views.npz"
        data = simulate(views)
        np.savez(path, **data)  # type: ignore[arg-type]
        runs: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
        for _ in range(arguments.repeats):
            for name in names:
                if not any("failed" in one for one in runs[name]):
                    runs[name].append(run(name, path, coefficients, arguments.timeout))
        judged = {
            name: judge(data, dict(np.load(path.with_suffix(f".{name}.npz"))), coefficients)
            for name in names
            if "failed" not in runs[name][-1]
        }
    best = min((one["rms"] for one in judged.values() if one["regular"]), default=float("nan"))
    own = {name: [one.get("seconds", float("nan")) for one in runs[name]] for name in names if name.startswith("kcal")}
    lines: list[list[Any]] = []
    for name in names:
        mine = ("kcal",) if coefficients == 5 else ("kcal", "kcal, weak prior")
        if name not in judged:
            lines.append([views, name, runs[name][-1]["failed"], *[""] * (len(mine) + len(COLUMN_NAMES))])
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
        lines.append([
            views, name, f"{1e3 * statistics.median(seconds):.0f}", *cells, f"{one['rms']:.6f}", excess,
            f"{one['truth']:.2f}", one["flipped"], f"{memory:.0f}",
        ])  # fmt: skip
    return lines, {name: statistics.median(one["seconds"] for one in runs[name]) for name in judged}


def growth(seconds: dict[tuple[int, int], dict[str, float]]) -> list[str]:
    """How kcal's time grows with the views and with the coefficients."""
    lines = []
    sizes, models = sorted({views for views, _ in seconds}), sorted({count for _, count in seconds})
    for name in ("kcal", "kcal, weak prior"):
        told = []
        for count in models:
            known = [(views, seconds[views, count][name]) for views in sizes if name in seconds[views, count]]
            if len(known) > 1:
                (few, quick), (many, slow) = known[-2:]
                told.append(f"{count} coefficients {np.log(slow / quick) / np.log(many / few):.2f}")
        if told:
            lines.append(f"Time of *{name}* grows with the views, {few} to {many}, to the power of: {', '.join(told)}.")
        pairs = [
            f"{seconds[views, 20][name] / seconds[views, 14][name]:.2f} at {views}"
            for views in sizes
            if name in seconds.get((views, 20), {}) and name in seconds.get((views, 14), {})
        ]
        if pairs:
            lines.append(f"20 coefficients take, times 14: {', '.join(pairs)} views.")
    return lines


def main() -> None:
    if sys.argv[1:2] == ["--work"]:
        work(sys.argv[2], sys.argv[3], int(sys.argv[4]))
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, nargs="*", default=[15, 50, 200, 800])
    parser.add_argument("--coefficients", type=int, nargs="*", default=list(MODELS), choices=list(MODELS))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--timeout", type=float, default=60.0)
    parser.add_argument("--write", action="store_true", help="write the table into the page")
    arguments = parser.parse_args()
    arguments.solvers = [name for name in SOLVERS if name not in PYTHON or os.environ.get(PYTHON[name])]
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    seconds = {}
    for coefficients in arguments.coefficients:
        ratios = ["kcal / this"] if coefficients == 5 else ["kcal / this", "kcal, weak prior / this"]
        lines = show(table(["views", "solver", "ms", *ratios, *COLUMN_NAMES], []))
        for views in arguments.views:
            found, seconds[views, coefficients] = compare(views, coefficients, arguments)
            lines += show([row(*cells) for cells in found])
        if coefficients in SECTIONS and arguments.write:
            write_section("solver.md", SECTIONS[coefficients], lines)
    show(growth(seconds))


if __name__ == "__main__":
    main()
