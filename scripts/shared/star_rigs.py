"""Simulated rigs under the stars: two cameras 10 m apart, marks of stars, matches of unknown range, a baseline."""

from __future__ import annotations

import datetime
import math

import numpy as np
import torch
from torch import Tensor

from kcal import Baseline, Camera, MeasuredPosition, RigData
from kcal.calibrate.rig.marks import StarSource
from kcal.lens.projection import FAR
from kcal.locate import enu_from_cam
from kcal.rig import Effect
from kcal.stars.sky import EARTH_RATE, StarCatalog, observed_directions, pole_in_enu
from scripts.shared.long_range import matches_of
from scripts.shared.night_scenes import PLACE, TIME

BASELINE, STAR = 10.0, 0.1  # m, px
LOOKS = ((40.0, 12.0, 1.0), (41.5, 12.5, -0.5))


def star_rig(
    camera: Camera,
    *,
    seed: int,
    named: bool,
    moments: int = 1,
    clock: float = 0.0,
    clock_sigma: float = 0.02,
    drift: float = 0.0,
    drift_sigma: float = 0.0,
    faintest: float = 5.0,
    positions: bool = True,
    matches: int = 12,
) -> tuple[RigData, Tensor, Tensor]:
    """Data of a rig, and the true rotations (2, 3, 3) and centers (2, 3) in east, north, up.

    Args:
        camera: both.
        seed: of all noise.
        named: stars with directions, or without.
        moments: pairs of images, 25 minutes apart.
        clock: seconds by which the second camera's images are late.
        clock_sigma: as stated.
        drift: seconds an hour by which it is later and later.
        drift_sigma: as stated.
        faintest: magnitude.
        positions: whether the cameras' positions are measured, to 1 cm.
        matches: features of unknown range.
    """
    draw = np.random.default_rng(seed)
    rotation = torch.stack([enu_from_cam(*look).T for look in LOOKS])
    center = torch.stack([torch.zeros(3).double(), BASELINE * enu_from_cam(*LOOKS[0])[:, 0]])
    catalog, names, pixels, direction = StarCatalog.bundled(), [], [], []
    for moment in range(moments):
        time = TIME + datetime.timedelta(minutes=25 * moment)
        late = (0.0, clock + drift * moment * 25 / 60)
        seen = [observed_directions(catalog, time + datetime.timedelta(seconds=s), PLACE) for s in late]
        index = np.flatnonzero((catalog.magnitude < faintest) & (seen[0][:, 2] > math.sin(math.radians(6.0))))
        marks = [
            camera.project(FAR * torch.from_numpy(one[index]) @ turn.T)
            for one, turn in zip(seen, rotation, strict=True)
        ]
        good = torch.stack([valid & camera.inside(at) for at, valid in marks]).all(0)
        pixels.append(torch.stack([at[good] for at, _ in marks], 1))
        direction.append(torch.from_numpy(seen[0][index])[good])
        names += [f"HR {catalog.number[i]} at {moment}" for i in index[good.numpy()]]
    clean, known = torch.cat(pixels), torch.cat(direction)
    turn = -EARTH_RATE * clock_sigma * torch.from_numpy(pole_in_enu(PLACE.lat))
    effects = [Effect(name="the clock of the second camera", turn=torch.stack([torch.zeros_like(turn), turn]))]
    if drift_sigma:
        hours = torch.tensor([int(name.split()[-1]) * 25 / 60 for name in names]).double()
        each = effects[0].turn
        assert each is not None
        effects.append(Effect(name="its drift", turn=each * drift_sigma / clock_sigma, factor=hours))
    stars = StarSource(
        names=tuple(names),
        pixels=clean + torch.from_numpy(draw.normal(0, STAR, clean.shape)),
        pixel_sigma=torch.full(clean.shape[:2], STAR).double(),
        direction=known if named else torch.full_like(known, torch.nan),
        direction_sigma=torch.full((len(names),), 5e-6 if named else math.inf).double(),
        effects=tuple(effects),
    )
    features = None
    if matches:
        way = draw.uniform((-0.4, -0.2), (0.4, 0.2), (matches, 2))
        rays = torch.nn.functional.pad(torch.from_numpy(way), (0, 1), value=1.0)
        points = torch.from_numpy(draw.uniform(100, 1500, (matches, 1))) * rays @ rotation[0]
        at = torch.stack([camera.project((points - c) @ r.T)[0] for r, c in zip(rotation, center, strict=True)], 1)
        features = matches_of(at + torch.from_numpy(draw.normal(0, 0.1, at.shape)), pixel_sigma=0.1)
    places = [
        MeasuredPosition(
            camera=c, point=center[c] + torch.from_numpy(draw.normal(0, 0.01, 3)), sigma=torch.full((3,), 0.01).double()
        )
        for c in (0, 1)
    ]
    data = RigData(
        cameras=(camera, camera),
        names=("left", "right"),
        stars=stars,
        features=features,
        baselines=(Baseline(first=0, second=1, length=BASELINE + draw.normal(0, 0.002), sigma=0.002),),
        positions=tuple(places) if positions else (),
    )
    return data, rotation, center
