"""A rig behind two traced lenses for `scripts.check.chain`: its landmarks, its targets, and what a solved rig is worth.

Errors are those of the inverse range, which is Gaussian at any distance, where the range is not.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from kcal import Camera, KcalError, Landmarks, Localizer, RigData, RigOptions, solve_rig
from kcal.locate import enu_from_cam
from kcal.rig import placed_rig
from kcal.sim.captures import TrueRig, drawn_rig
from kcal.sim.raytrace import SURVEILLANCE
from scripts.shared.long_range import ORIGIN, RANGES, landmarks_of, range_sigma, with_noise

How = Literal["held", "prior"]
LANDMARKS, NEAR, FAR = 12, 40.0, 400.0  # number, meters
SURVEY, LANDMARK_MARK, MARK = 0.02, 0.07, 0.1  # meters, px, px
EDGE = 40.0  # px between landmarks and the edges of the images
SUMS = ("count", "inside", "total", "share", "meters", "expected", "lost")
COLUMNS, ROWS = 9, 5  # of the left image's grid, at whose cells' centers there are targets
ENU_FROM_RIG = enu_from_cam(35.0)
# mm: with this focal length the entrance pupil of the surveillance lens moves by 3 mm/rad² as `TruthLens` traces it
# (`wander` 1). Seen in pixels the lens is the same at any size; a pixel is 3.9 µm.
FOCAL_MM, FULL_PUPIL = 6.163, 3.0


class Targets(NamedTuple):
    """Points at all ranges in all directions that both cameras see, T of them.

    Attributes:
        ring: (T,) which of `RANGES`.
        inverse: (T,) one over the distance from the left camera.
        pixels: (2, T, 2) where the left and the right camera truly see them.
        bound: (T,) standard deviation of the inverse range by marks of `MARK` px alone.
    """

    ring: Tensor
    inverse: Tensor
    pixels: Tensor
    bound: Tensor


def true_rig(draw: int, pupil: float) -> TrueRig:
    """Two lenses of one design, with errors of assembly of their own, 10 m apart and nearly parallel.

    Args:
        draw: seed of the lenses.
        pupil: movement of the entrance pupil, mm/rad².
    """
    return drawn_rig(SURVEILLANCE, 1.0, draw, focal_mm=FOCAL_MM, wander=pupil / FULL_PUPIL)


def targets(rig: TrueRig) -> Targets:
    """Targets of a rig: all directions of a grid of the left image at all ranges, where both cameras see them."""
    width, height = rig.left.size
    x, y = ((torch.arange(n).double() + 0.5) * size / n - 0.5 for n, size in ((COLUMNS, width), (ROWS, height)))
    rays = rig.left.unproject(torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2))[0]
    points = (torch.tensor(RANGES, dtype=torch.float64)[:, None, None] * rays).reshape(-1, 3)
    pixels, valid = rig(points)
    (left, right), valid = pixels.unbind(-2), valid.all(-1)
    seen = valid & rig.left.inside(left) & rig.right.inside(right)
    ring = torch.arange(len(RANGES)).repeat_interleave(len(rays))[seen]
    inverse = 1.0 / points[seen].norm(dim=-1)
    bound = range_sigma(rig, points[seen], MARK) * inverse.square()
    return Targets(ring, inverse, torch.stack([left[seen], right[seen]]), bound)


def landmarks(rig: TrueRig, generator: torch.Generator) -> tuple[Landmarks, Landmarks]:
    """Landmarks all over the common image: as surveyed and marked, and the same without any noise."""

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, dtype=torch.float64, generator=generator)

    size = torch.tensor(rig.left.size, dtype=torch.float64) - 1.0
    pixels = EDGE + uniform(20 * LANDMARKS, 2) * (size - 2 * EDGE)
    distance = NEAR * (FAR / NEAR) ** uniform(20 * LANDMARKS, 1)
    points = distance * rig.left.unproject(pixels)[0]
    pixels, valid = rig(points)
    right = pixels[:, 1]
    kept = (valid.all(-1) & ((right > EDGE) & (right < size - EDGE)).all(-1)).nonzero()[:LANDMARKS, 0]
    exact = landmarks_of(points[kept] @ ENU_FROM_RIG.T, pixels[kept], SURVEY, LANDMARK_MARK)
    return with_noise(exact, generator), exact


def localizer(cameras: tuple[Camera, Camera], seen: Landmarks, how: How) -> Localizer:
    """The rig solved from landmarks, with what it knows of itself.

    Args:
        cameras: left and right, calibrated.
        seen: the landmarks.
        how: the cameras are held as exact, or their calibrations are priors. This is the one place that decides it.

    Raises:
        KcalError: the rig cannot be solved, or says nothing about its errors.
    """
    data = RigData(cameras=cameras, names=("left", "right"), landmarks=seen)
    # The simulated light goes straight.
    options = RigOptions(intrinsics="prior" if how == "prior" else "fixed", refraction=0.0, refraction_sigma=0.0)
    rig = placed_rig(solve_rig(data, options), ORIGIN)
    if rig.covariance is None or rig.mounting is None:
        raise KcalError("the solved rig has no covariance or no mounting")
    return Localizer(rig, pixel_sigma=MARK)


def judge(
    cameras: tuple[Camera, Camera], how: How, rig: TrueRig, points: Targets, seed: int, marks: int, exact: int
) -> dict[str, Any]:
    """What two cameras are worth, over draws of landmarks and marks.

    Args:
        cameras: left and right.
        how: see `localizer`.
        rig: the truth.
        points: `targets` of it.
        seed: of the draws.
        marks: how many draws.
        exact: the first so many places of landmarks are also used without noise.

    Returns:
        sums: for each range, over draws and targets: their number ("count"), "inside" the 95 % interval, squared errors
            of the inverse range over the bound with noisy marks of the targets ("total") and with exact ones ("share";
            over the slope of the inverse range, m²: "meters"), and what the localizer expects of the first
            ("expected"). Targets without an answer are "lost" and not counted.
        lenses_m: for each exact draw, RMS over the targets at the largest range of the error of the inverse range, over
            its slope, in meters.
        failed: messages, and how many runs ended with each; runs: how many did not.
    """
    sums = {name: torch.zeros(len(RANGES), dtype=torch.float64) for name in SUMS}
    failed, lenses, runs = dict[str, int](), list[float](), 0
    far = points.ring == len(RANGES) - 1
    for number in range(marks):
        generator = torch.Generator().manual_seed(seed + number)
        noisy, noiseless = landmarks(rig, generator)
        marked = points.pixels + MARK * torch.randn(points.pixels.shape, dtype=torch.float64, generator=generator)
        try:
            solved = localizer(cameras, noisy, how)
            found, clean = solved(*marked), solved(*points.pixels)
            if number < exact:
                alone = localizer(cameras, noiseless, how)(*points.pixels[:, far])
                there = alone.inverse_range_sigma > 0
                error = (alone.inverse_range - points.inverse[far]) / points.inverse[far].square()
                lenses.append(float(error[there].square().mean().sqrt()))
        except (KcalError, RuntimeError) as error_found:
            message = f"{type(error_found).__name__}: {error_found}"
            failed[message] = failed.get(message, 0) + 1
            continue
        runs += 1
        there = (found.inverse_range_sigma > 0) & (clean.inverse_range_sigma > 0)
        true, bound = points.inverse, points.bound
        values = (
            torch.ones_like(true),
            (found.range_low <= 1.0 / true) & (1.0 / true <= found.range_high),
            ((found.inverse_range - true) / bound).square(),
            ((clean.inverse_range - true) / bound).square(),
            ((clean.inverse_range - true) / true.square()).square(),
            (found.inverse_range_sigma / bound).square(),
        )
        for name, value in zip(SUMS, values, strict=False):
            sums[name].index_add_(0, points.ring[there], value[there].double())
        sums["lost"].index_add_(0, points.ring[~there], torch.ones_like(true)[~there])
    return {"runs": runs, "failed": failed, "lenses_m": lenses, "sums": {n: v.tolist() for n, v in sums.items()}}
