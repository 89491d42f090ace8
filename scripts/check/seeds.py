"""Random cameras and captures: does calibration end at the optimum next to the truth?

    python -m scripts.check.seeds                              all sizes and models, four seeds each
    python -m scripts.check.seeds --views 50 --seeds 20 --first 5000

Each set has its own lens (mild to strong barrel, every coefficient of the model different from zero), focal length and
noise. The yardstick is Levenberg-Marquardt started at the true camera and poses, with the same model.
"""

from __future__ import annotations

import argparse
import statistics
import time
from typing import NamedTuple

import numpy as np
import torch

from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import free_parameters
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.result import SolverStatus
from scripts.shared.timing import show
from scripts.shared.views import MODELS, SIZE, flipped_views, image_error, observed, simulate

SAME = 1e-6
# Typical sizes of coefficients that may have either sign.
SPREAD = {
    "p1": 5e-4, "p2": 5e-4, "k4": 0.03, "k5": 0.015, "k6": 0.005, "s1": 5e-4, "s2": 3e-4, "s3": 5e-4, "s4": 3e-4,
    "tau_x": 0.005, "tau_y": 0.005, "k7": 0.003, "k8": 0.001, "k9": 0.002, "k10": 0.001, "s5": 2e-4, "s6": 2e-4,
}  # fmt: skip


class Outcome(NamedTuple):
    """One set: RMS of calibration and of the yardstick, and how far calibration is from the truth."""

    seed: int
    k1: float
    noise: float
    rms: float
    yardstick: float
    yardstick_folds: bool
    flipped: int
    focal_error: float
    image_error: float
    status: SolverStatus
    seconds: float

    @property
    def excess(self) -> float:
        """Relative, of the RMS."""
        return self.rms / self.yardstick - 1.0

    def __str__(self) -> str:
        folds = ", the yardstick folds" if self.yardstick_folds else ""
        return f"seed {self.seed}: {self.excess:+.1e} (k1 {self.k1:.3f}, noise {self.noise:.3f} px{folds})"


def random_camera(rng: np.random.Generator, model: LensModel) -> Camera:
    """A camera whose lens is regular all over the image."""
    while True:
        barrel = rng.uniform(0.05, 0.4)
        own = {"k1": -barrel, "k2": barrel**2 * rng.uniform(0.3, 1.0), "k3": -(barrel**3) * rng.uniform(0.0, 0.5)}
        coefficients = [own[name] if name in own else rng.normal(0, SPREAD[name]) for name in model.names]
        focal = SIZE[0] * rng.uniform(0.6, 1.2)
        center = tuple((np.array(SIZE) - 1) / 2 + rng.normal(0, 10, 2))
        focals = (focal, focal * rng.uniform(0.99, 1.01))
        camera = Camera.build(focal=focals, center=center, size=SIZE, coefficients=coefficients, model=model)
        if bool(camera.covers_image()):
            return camera


def judge(seed: int, views: int, model: LensModel) -> Outcome:
    rng = np.random.default_rng(seed)
    truth, noise = random_camera(rng, model), rng.uniform(0.1, 0.3)
    data = simulate(views, truth, noise=noise, seed=seed)
    seen = observed(data["pixels"].tolist())
    clock = time.process_time()
    result = calibrate_camera(seen, CalibrationOptions(model=model))
    seconds = time.process_time() - clock
    problem = BoardProblem(seen.board.points, seen.pixels(), model, free_parameters(model))
    poses = torch.from_numpy(data["rotation"]), torch.from_numpy(data["translation"])
    start = BoardState.flat(truth.params.detach(), *poses)
    best = minimize(problem, start, LMOptions(max_iterations=1000, tolerance=1e-12))
    sigma = result.sigma["fx"]
    return Outcome(
        seed=seed,
        k1=float(truth.coefficients[0]),
        noise=noise,
        rms=result.rms,
        yardstick=float(torch.sqrt(4.0 * best.cost / problem.residual_count)),
        yardstick_folds=not bool(Camera(best.state.parameters, size=SIZE, model=model).covers_image()),
        flipped=int(flipped_views(result.cam_from_board_rotation.numpy(), data["rotation"]).sum()),
        focal_error=abs(float(result.camera.focal[0] - truth.focal[0])) / (np.inf if sigma is None else sigma),
        image_error=image_error(result.camera, truth),
        status=result.status,
        seconds=seconds,
    )


def row(views: int, coefficients: int, found: list[Outcome]) -> str:
    fair = [one for one in found if not one.yardstick_folds]
    above = [one for one in fair if one.excess > SAME]
    below = sum(one.excess < -SAME for one in found)
    worst = str(max(above, key=lambda one: one.excess)) if above else ""
    errors = [one.image_error for one in found]
    furthest = max(found, key=lambda one: one.focal_error)
    return (
        f"| {views} | {coefficients} | {len(found)} | {len(found) - len(fair)} | {len(above)} | {below} | {worst} | "
        f"{sum(one.flipped for one in found)} | {statistics.median(errors):.3f}, {max(errors):.3f} | "
        f"{furthest.focal_error:.1f} (seed {furthest.seed}) | {statistics.median(o.seconds for o in found):.2f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, nargs="*", default=[15, 50, 200])
    parser.add_argument("--coefficients", type=int, nargs="*", default=[5, 14, 20], choices=list(MODELS))
    parser.add_argument("--seeds", type=int, default=4, help="sets of each kind")
    parser.add_argument("--first", type=int, default=7000, help="the first seed")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    heads = "views coefficients sets folds above below worst_above flipped image_px fx_error/σ s"
    print("| " + " | ".join(heads.split()) + " |", flush=True)
    for views in arguments.views:
        for coefficients in arguments.coefficients:
            model = LensModel.named(MODELS[coefficients])
            first = arguments.first + 1000 * views + 100 * coefficients
            found = [judge(first + k, views, model) for k in range(arguments.seeds)]
            show([row(views, coefficients, found)])
            for one in found:
                if one.excess > SAME:
                    print(f"    {one}, {one.status.name}", flush=True)


if __name__ == "__main__":
    main()
