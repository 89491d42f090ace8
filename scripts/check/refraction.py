"""Refraction of light: heights at 5 km when the coefficient is not what was assumed, with and without far landmarks.

Truth: light bends with a coefficient of 0.13 + 0.2, 0.13 - 0.2, or one drawn from 0.13 ± 0.1. A rig of known lenses
(scripts/shared/long_range.py) is solved from 12 landmarks, surveyed to 2 cm and marked to 0.07 px: near (40 to 400 m),
or so that half of them stand 4 to 5 km away. Targets stand 5 km away all over the image. Their height is found with the
rig's own coefficient.

Error without noise: neither survey nor marks have any, so that only the coefficient is wrong.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from kcal import Localizer, RigData, RigOptions, solve_rig
from kcal.lens.pose import enu_from_cam
from kcal.lens.rig import REFRACTION, REFRACTION_SIGMA
from kcal.locate.geodesy import mean_radius
from kcal.rig import placed_rig
from scripts.shared.long_range import ORIGIN, landmarks_of, rig, with_noise
from scripts.shared.page import table
from scripts.shared.sections import section

COUNT, SURVEY, MARK = 12, 0.02, 0.07  # landmarks; meters, px
TARGET_RANGE = 5000.0
NEAR, FAR = (40.0, 400.0), (4000.0, 5000.0)  # meters
ENU_FROM_CAM = enu_from_cam(35.0)


class Site(NamedTuple):
    """Landmarks (L, 3) and targets (T, 3) in east, north, up, and their pixels (L or T, 2, 2)."""

    landmarks: Tensor
    landmark_marks: Tensor
    targets: Tensor
    target_marks: Tensor


def site(refraction: float, far: bool, generator: torch.Generator) -> Site:
    """Things as they stand, and where both cameras see them in light that bends."""
    world = rig()

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, dtype=torch.float64, generator=generator)

    def seen(enu: Tensor) -> tuple[Tensor, Tensor]:
        lift = 0.5 * refraction / mean_radius(ORIGIN.lat) * enu[:, :2].square().sum(-1)
        above = enu + lift[:, None] * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        pixels, valid = world(above @ ENU_FROM_CAM)
        return pixels, valid.all(-1)

    def places(count: int, low: float, high: float) -> Tensor:
        pixels = 60.0 + uniform(8 * count, 2) * torch.tensor([1800.0, 960.0], dtype=torch.float64)
        points = low * (high / low) ** uniform(8 * count, 1) * world.left.unproject(pixels)[0] @ ENU_FROM_CAM.T
        marks, valid = seen(points)
        good = valid & ((marks > 20) & (marks < torch.tensor([1900.0, 1060.0]).double())).all(-1).all(-1)
        return points[good][:count]

    here = torch.cat([places(COUNT // 2, *NEAR), places(COUNT // 2, *(FAR if far else NEAR))])
    there = places(40, TARGET_RANGE, TARGET_RANGE)
    return Site(here, seen(here)[0], there, seen(there)[0])


def heights(place: Site, generator: torch.Generator, noise: float) -> tuple[Tensor, Tensor, float]:
    """Errors (T,) of the targets' heights, their sigmas (T,), and the coefficient that was found."""
    exact = landmarks_of(place.landmarks, place.landmark_marks, SURVEY, MARK)
    noisy = with_noise(exact, generator)
    world = rig()
    data = RigData(cameras=(world.left, world.right), names=("left", "right"), landmarks=noisy if noise else exact)
    solved = solve_rig(data, RigOptions(intrinsics="fixed", refraction_sigma=REFRACTION_SIGMA))
    localize = Localizer(placed_rig(solved, ORIGIN), pixel_sigma=MARK)
    error = noise * torch.randn(place.target_marks.shape, dtype=torch.float64, generator=generator)
    marks = place.target_marks + MARK * error
    found = localize(marks[:, 0], marks[:, 1])
    # Across the line of sight, upward: errors of the range are not those of light.
    sight = torch.nn.functional.normalize(place.targets, dim=-1)
    level = torch.nn.functional.normalize(sight[:, :2], dim=-1)
    upward = torch.cat([-sight[:, 2:] * level, (sight[:, :2] * level).sum(-1, keepdim=True)], -1)
    ratio = place.targets.norm(dim=-1) / found.enu.norm(dim=-1)
    error = ((found.enu * ratio[:, None] - place.targets) * upward).sum(-1)
    spread = torch.einsum("ni,nij,nj->n", upward, found.covariance, upward).sqrt() * ratio
    return error, spread, solved.refraction


def rows(draws: int) -> Iterator[list[str]]:
    """One row for each truth and place of the landmarks."""
    truths = {"0.33": 0.33, "-0.07": -0.07, "0.13 ± 0.1": None}
    for (name, truth), far in itertools.product(truths.items(), (False, True)):
        bias, errors, inside, found = [], [], [], []
        for draw in range(draws):
            generator = torch.Generator().manual_seed(7000 + draw)
            own = torch.randn((), dtype=torch.float64, generator=generator)
            k = REFRACTION + REFRACTION_SIGMA * float(own) if truth is None else truth
            place = site(k, far, generator)
            error, _, _ = heights(place, generator, 0.0)
            bias.append(error.square().mean())
            error, sigma, estimate = heights(place, generator, 1.0)
            errors.append(error.square().mean())
            inside.append((error.abs() <= 1.96 * sigma).double().mean())
            found.append(estimate - k)
        rms, noisy, share = (torch.stack(values).mean() for values in (bias, errors, inside))
        off = torch.tensor(found).square().mean().sqrt()
        yield [
            name, "half at 4 to 5 km" if far else "at 40 to 400 m", f"± {float(off):.3f}",
            f"{float(rms.sqrt()):.3f}", f"{float(noisy.sqrt()):.3f}", f"{100 * float(share):.1f}",
        ]  # fmt: skip


@section("rig.md", "refraction", draws=1)
def refraction(draws: int = 40) -> Iterator[str]:
    heads = ["true coefficient", "landmarks", "found", "height error at 5 km without noise, m"]
    return table([*heads, "with noise, m", "inside the 95 % interval, %"], rows(draws))
