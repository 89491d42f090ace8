"""Targets that move before a rig of known errors, for tests and measurements of tracks."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal import Localizer, Origin, Rig
from kcal.lens import rotation_from_vector
from kcal.locate.points import PointLocator
from kcal.locate.positions import Located
from kcal.pipeline.pairing import ObjectViews
from kcal.rig import RigCovariance, planned_rig

ORIGIN = Origin(lat=19.07, lon=72.87, height=14.0)


def yawed_rig(rig: Rig, yaw: float) -> Rig:
    """The rig with its right camera turned about its y axis, radians."""
    turn = rotation_from_vector(torch.tensor([0.0, yaw, 0.0], dtype=torch.float64))
    return Rig.pair(rig.left, rig.right, turn @ rig.right_from_left_rotation, rig.right_from_left_translation)


def tracked_site(yaw_deg: float = 0.0, **options: object) -> Localizer:
    """The planned rig, f = 1600 px and 10 m of baseline, whose relative yaw is known to a sigma; straight light."""
    rig = planned_rig()
    pose = torch.zeros(6, 6, dtype=torch.float64)
    pose[1, 1] = math.radians(yaw_deg) ** 2
    known = {"origin": ORIGIN, "heading_deg": 0.0, "refraction": 0.0, "refraction_sigma": 0.0} | options
    rig.covariance = RigCovariance.of(rig, pose=pose)
    return Localizer(rig.placed(**known))  # type: ignore[arg-type]


def run_of(site: Localizer) -> Located:
    """What is located at that place, looking north."""
    return PointLocator(Localizer(site.rig.placed(origin=site.origin, heading_deg=0.0))).located()


def pairs_of(
    left: Tensor, right: Tensor, time: float | Tensor, sigma: float = 0.3, ambiguous: Sequence[bool] | None = None
) -> ObjectViews:
    """Pairs of one category; `time` is that of both, or (2,)."""
    count = len(left)
    return ObjectViews.of_pairs(
        left,
        right,
        covariance=sigma**2 * torch.eye(4, dtype=torch.float64).expand(count, 4, 4),
        time=torch.as_tensor(time, dtype=torch.float64).expand(count, 2).clone(),
        score=torch.ones(count),
        category=("car",) * count,
        ambiguous=torch.tensor(ambiguous or [False] * count, dtype=torch.bool),
    )


def seen_by(
    rig: Rig, places: Tensor, sigma: float, generator: torch.Generator, later: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Marks of places (N, 3) in the rig frame with noise; the right camera sees them where they are `later`."""
    left = rig.left.project(places)[0]
    right = rig.right.project(rig.right_from_left(places if later is None else later))[0]
    noise = sigma * torch.randn(2, len(places), 2, generator=generator, dtype=torch.float64)
    return left + noise[0], right + noise[1]
