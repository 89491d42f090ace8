"""Rigs from targets that report their position: a drone with RTK, ships with AIS, aircraft with ADS-B.

Two cameras 10 m apart, f 1600 px, marks of 0.3 px; their clocks are 0.7 s late, and 0.05 s apart. Positions of the
cameras are known to 20 mm (GNSS), the baseline to 5 mm. A drone: fixes at 10 Hz of 20 mm, one minute, 120 to 260 m
away. Ships: a fix every 8 s, rounded to 1/10,000 of a minute as AIS does, 3 m of noise, an antenna 10 m from what is
seen, times late by 0.3 s (one sigma each), six ships 2.5 to 4 km away for ten minutes. Aircraft: a fix every second,
rounded to 25 feet of height, 5 m of noise and 15 m in common, 0.2 s late, five of them 8 to 20 km away for four
minutes. Of the names of ships and aircraft 30 % are wrong.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from kcal import Baseline, Camera, KcalError, MeasuredPosition, RigData, solve_rig
from kcal.lens import rotation_from_vector, vector_from_rotation
from kcal.locate.moving import CLOCK, MovingOptions, MovingTrack, Sighting, match_moving
from scripts.shared.page import Lines, rms, section, table, timed

CAMERA = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080), model="pinhole")
CENTERS = torch.tensor([[0.0, 0, 0], [10.0, 0, 0]], dtype=torch.float64)
LOOK = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
LATE, APART, MARK, PLACE, TAPE = 0.7, 0.05, 0.3, 0.02, 0.005
NAMES = ("left", "right")
HALF_CURVATURE, REFRACTION = 0.5 / 6_371_008.8, 0.13


class Kind(NamedTuple):
    """What moves, and what its receiver tells."""

    things: int
    interval: float
    duration: float
    sigma: tuple[float, float]
    constant: tuple[float, float]
    latency: float
    rounding: tuple[float, float]
    wrong: float
    every: float


KINDS = {
    "drone": Kind(1, 0.1, 60.0, (0.02, 0.02), (0.0, 0.0), 0.0, (0.0, 0.0), 0.0, 0.2),
    "ships": Kind(6, 8.0, 600.0, (3.0, 3.0), (10.0, 3.0), 0.3, (0.185, 0.0), 0.3, 2.0),
    "aircraft": Kind(5, 1.0, 240.0, (5.0, 5.0), (15.0, 15.0), 0.2, (0.0, 7.62), 0.3, 0.5),
}


def path_of(kind: str, random: torch.Generator) -> Callable[[Tensor], Tensor]:
    """Where one of them is, by seconds."""
    draw = torch.rand(6, generator=random, dtype=torch.float64)
    if kind == "drone":
        phase = 6.28 * draw[:3]

        def circling(t: Tensor) -> Tensor:
            return torch.stack(
                [80 * torch.sin(0.15 * t + phase[0]), 190 + 70 * torch.sin(0.11 * t + phase[1]),
                 5 + 35 * torch.sin(0.13 * t + phase[2])], -1,
            )  # fmt: skip

        return circling
    if kind == "ships":
        begin = torch.stack([1600 * draw[0] - 800, 2500 + 1500 * draw[1], torch.tensor(-20.0, dtype=torch.float64)])
        speed, course, rate, climb = 3 + 5 * draw[2], 6.28 * draw[3], 2e-3 * (draw[4] - 0.5), 0.0 * draw[0]
    else:
        begin = torch.stack([8000 * (draw[0] - 0.5), 8000 + 12000 * draw[1], 1500 + 3000 * draw[5]])
        speed, course, rate, climb = 70 + 60 * draw[2], 6.28 * draw[3], 6e-3 * (draw[4] - 0.5), 8 * (draw[0] - 0.5)

    def turning(t: Tensor) -> Tensor:
        fine = torch.arange(-30.0, 700.0, 0.5, dtype=torch.float64)
        angle = course + rate * fine
        steps = 0.5 * speed * torch.stack([angle.cos(), angle.sin()], -1)
        level = torch.cumsum(steps, 0)
        at = (t + 30.0) / 0.5
        low = at.floor().long().clamp(0, len(fine) - 2)
        place = level[low] + (at - low)[:, None] * (level[low + 1] - level[low]) + begin[:2]
        return torch.cat([place, (begin[2] + climb * t)[:, None]], -1)

    return turning


class Outcome(NamedTuple):
    """One draw."""

    yaw: float
    sigma: float
    squares: float
    late: float
    late_sigma: float
    matched: float
    false: int
    cpu: float


class Site(NamedTuple):
    """What a simulated site gives, and its truth: attitudes, and names of sightings."""

    tracks: list[MovingTrack]
    sightings: list[Sighting]
    positions: tuple[MeasuredPosition, ...]
    tape: Baseline
    attitude: list[Tensor]
    truth: list[str]


def simulated(name: str, seed: int) -> Site:
    """One site."""
    kind, random = KINDS[name], torch.Generator().manual_seed(seed)

    def noise(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=random, dtype=torch.float64)

    attitude = [rotation_from_vector(0.02 * noise(3)) @ LOOK for _ in NAMES]
    tracks, sightings = [], []
    times = torch.arange(0.0, kind.duration, kind.interval, dtype=torch.float64)
    sigma, constant = (
        torch.tensor([level, level, up], dtype=torch.float64) for level, up in (kind.sigma, kind.constant)
    )
    step = torch.tensor([kind.rounding[0], kind.rounding[0], kind.rounding[1]], dtype=torch.float64)
    for i in range(kind.things):
        path = path_of(name, random)
        late, antenna = float(kind.latency * noise(1)), constant * noise(3)
        fixes = path(times) + sigma * noise(len(times), 3)
        fixes = torch.where(step > 0, (fixes / step.clamp_min(1e-9)).round() * step, fixes)
        stated = (sigma.square() + step.square() / 12).sqrt().expand(len(times), 3)
        tracks.append(
            MovingTrack(
                name=f"{name}{i}", times=times + late, points=fixes, sigma=stated, constant=tuple(constant.tolist()),
                latency=kind.latency,
            )
        )  # fmt: skip
        for c in range(2):
            seen = torch.arange(2.0, kind.duration - 4.0, kind.every, dtype=torch.float64)
            offset = path(seen + LATE + APART * c) + antenna - CENTERS[c]
            offset[:, 2] += REFRACTION * HALF_CURVATURE * offset[:, :2].square().sum(-1)
            pixels, valid = CAMERA.project(offset @ attitude[c].T)
            pixels = pixels + MARK * noise(len(seen), 2)
            inside = valid & (pixels > 0).all(-1) & (pixels[:, 0] < 1919) & (pixels[:, 1] < 1079)
            if int(inside.sum()) > 3:
                unknown = torch.full((int(inside.sum()),), math.nan, dtype=torch.float64)
                sightings.append(
                    Sighting(label=f"{name}{i}", camera=c, times=seen[inside], pixels=pixels[inside], sigma=unknown)
                )
    truth = [one.label for one in sightings]
    for i in torch.randperm(len(sightings), generator=random)[: round(kind.wrong * len(sightings))].tolist():
        other = int(truth[i].removeprefix(name)) + 1 + int(torch.randint(kind.things - 1, (1,), generator=random))
        sightings[i] = dataclasses.replace(sightings[i], label=f"{name}{other % kind.things}")
    positions = tuple(
        MeasuredPosition(camera=c, point=CENTERS[c] + PLACE * noise(3), sigma=torch.full((3,), PLACE).double())
        for c in range(2)
    )
    tape = Baseline(first=0, second=1, length=10.0 + TAPE * float(noise(1)), sigma=TAPE)
    return Site(tracks, sightings, positions, tape, attitude, truth)


def one_draw(name: str, seed: int) -> Outcome:
    """Errors of a rig from one simulated site."""
    tracks, sightings, positions, tape, attitude, truth = simulated(name, seed)
    found, matching = timed(match_moving, tracks, sightings, (CAMERA, CAMERA), NAMES, positions)
    data = RigData(cameras=(CAMERA, CAMERA), names=NAMES, landmarks=found.landmarks, positions=positions)
    rig, solving = timed(solve_rig, dataclasses.replace(data, baselines=(tape,)))
    relative = rig.stereo().right_from_left_rotation.detach() @ (attitude[1] @ attitude[0].T).T
    error, covariance = vector_from_rotation(relative), rig.relative_covariance()[:3, :3]
    amount, spread = rig.effects()[CLOCK]
    prior = MovingOptions().clock_sigma
    ordered = [label for c in range(2) for one, label in zip(sightings, truth, strict=True) if one.camera == c]
    right = [one.track == label for one, label in zip(found.identities, ordered, strict=True)]
    false = sum(one.track not in (None, label) for one, label in zip(found.identities, ordered, strict=True))
    return Outcome(
        math.degrees(float(error[1])), math.degrees(float(covariance[1, 1].sqrt())),
        float(error @ torch.linalg.solve(covariance, error)), found.clock + prior * amount - LATE, prior * spread,
        sum(right) / len(right), false, matching + solving,
    )  # fmt: skip


def row_of(name: str, seeds: range) -> list[str]:
    """A row of the table."""
    found, refused = [], 0
    for seed in seeds:
        try:
            found.append(one_draw(name, seed))
        except KcalError as error:
            print(f"{name} {seed}: {error}")
            refused += 1
    value = torch.tensor(found, dtype=torch.float64)

    inside = float((value[:, 0].abs() < 1.96 * value[:, 1]).double().mean())
    known = float((value[:, 3].abs() < 1.96 * value[:, 4]).double().mean())
    return [
        name, f"{rms(value[:, 0]):.5f}", f"{float(value[:, 1].median()):.5f}", f"{inside:.0%}",
        f"{float(value[:, 2].mean() / 3):.2f}", f"{rms(value[:, 3]):.4f}", f"{float(value[:, 4].median()):.4f}",
        f"{known:.0%}", f"{float(value[:, 5].mean()):.1%}", f"{int(value[:, 6].sum())}", f"{refused} of {len(seeds)}",
        f"{float(value[:, 7].median()):.1f}",
    ]  # fmt: skip


HEADS = (
    "", "yaw °, RMS", "σ", "in 95 %", "χ² of attitude / 3", "clock s, RMS", "σ", "in 95 %", "named rightly",
    "named wrongly", "refused", "CPU s",
)  # fmt: skip


@section("moving.md", "moving", kinds=tuple(KINDS)[:1], seeds=range(1))
def moving(kinds: tuple[str, ...] = tuple(KINDS), seeds: range = range(30)) -> Lines:
    return table(HEADS, (row_of(name, seeds) for name in kinds))
