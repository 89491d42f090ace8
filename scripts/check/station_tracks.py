"""Tracks over stations: five of them 11 to 60 km apart on the round Earth, smokes, ships and drones, unlike clocks.

Each seed draws position, attitude and refraction errors, clocks (offset and rate) and targets anew, from what is
stated. Marks are rendered in each station's own east, north, up (`scripts/shared/station_scenes.py`), not as kcal
computes them. A camera misses a target in view with probability 0.15, and has one false detection an image. Halfway,
each station is blind for ten seconds, one after the other.

right: groups that are not doubtful and whose marks are all of one target; marks that tracks took and that are of the
target they follow. ghosts: told tracks that are of none. breaks: a target's track has another number than before.
inside: 95 % ellipsoids (chi-squared, 3) of tracks with a position, every tenth second.
"""

from __future__ import annotations

import itertools
import time
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal import Camera, Localizer, Rig
from kcal.lens.pose import enu_from_cam
from kcal.locate.geodesy import anchor, ecef_from_enu_rotation, enu_to_geodetic, geodetic_to_enu
from kcal.pipeline.pairing import ObjectViews
from kcal.track import AssociationOptions, ClockPrior, Detections, Motion, Tracker, TrackOptions, group_objects
from scripts.shared.page import Lines, section
from scripts.shared.station_scenes import ORIGIN, drawn_errors, marks, ring

BOX_PX, MISSED, FALSE = 1.0, 0.15, 1.0
POSITION_M, ATTITUDE_DEG, REFRACTION = 0.5, (0.004, 0.004, 0.01), 0.05
OFFSET_S, RATE = 0.5, 1e-4
SIZE = (1920, 1080)
# East, north, meters above the ellipsoid, heading.
PLACES = ((0, 0, 900, 0.0), (-9e3, 6e3, 1050, 40.0), (14e3, 2e3, 980, 330.0), (-12e3, 33e3, 1000, 120.0),
          (17e3, 52e3, 1150, 205.0))  # fmt: skip
INSIDE_95 = 7.814727903251179
OPTIONS = TrackOptions(
    motions=(Motion(acceleration=0.05), Motion(acceleration=0.5)), lose_after_s=8.0, forget_after_s=30.0,
    lasting_px=0.0,
)  # fmt: skip


class Site(NamedTuple):
    """One draw: the believed rig, its errors, clocks (offset, rate) of each camera, and targets at second zero."""

    rig: Rig
    errors: Tensor
    clocks: Tensor
    start: Tensor
    velocity: Tensor
    kind: tuple[str, ...]


def stations(count: int) -> Rig:
    camera = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=SIZE, model="pinhole")
    flat = torch.tensor([[e, n, 0.0] for e, n, *_ in PLACES[:count]], dtype=torch.float64)
    geodetic = enu_to_geodetic(flat, ORIGIN)
    geodetic[:, 2] = torch.tensor([place[2] for place in PLACES[:count]], dtype=torch.float64)
    base = anchor(ORIGIN)[0]
    turns = [
        enu_from_cam(place[3]).T @ ecef_from_enu_rotation(lat, lon).T @ base
        for (lat, lon, _), place in zip(geodetic.tolist(), PLACES, strict=False)
    ]
    names = [f"tower {c + 1}" for c in range(count)]
    return Rig([camera] * count, names, torch.stack(turns), center=geodetic_to_enu(geodetic, ORIGIN), origin=ORIGIN)


def drawn_site(seed: int, count: int, targets: int = 12) -> Site:
    g = torch.Generator().manual_seed(seed)
    rig = stations(count)
    rig.root = rig.with_errors(position_m=POSITION_M, attitude_deg=ATTITUDE_DEG, refraction=REFRACTION)
    errors = drawn_errors(rig.root, 1, g)
    clocks = torch.randn(len(PLACES), 2, generator=g).double() * torch.tensor([OFFSET_S, RATE]).double()
    clocks[0] = 0.0
    flat = torch.rand(targets, 2, generator=g).double() * torch.tensor([12e3, 16e3]) + torch.tensor([-6e3, 9e3])
    kind = tuple(("smoke", "ship", "drone")[i % 3] for i in range(targets))
    speed = torch.tensor([{"smoke": 0.0, "ship": 8.0, "drone": 25.0}[name] for name in kind]).double()
    height = torch.tensor([{"smoke": 850.0, "ship": 800.0, "drone": 1100.0}[name] for name in kind]).double()
    course = 6.28 * torch.rand(targets, generator=g).double()
    geodetic = enu_to_geodetic(torch.cat([flat, torch.zeros(targets, 1).double()], 1), ORIGIN)
    geodetic[:, 2] = height
    velocity = torch.stack([speed * course.sin(), speed * course.cos(), torch.zeros_like(speed)], -1)
    return Site(rig, errors, clocks[:count], geodetic_to_enu(geodetic, ORIGIN), velocity, kind)


def moment(site: Site, second: float, half: float, g: torch.Generator) -> tuple[list[Detections | None], list[Tensor]]:
    """Detections of each camera, and the targets that they are of, -1 for false ones."""
    seen: list[Detections | None] = []
    owners = []
    blind = int((second - half) // 10.0) if second >= half else -1
    for c in range(len(site.rig)):
        # What the camera calls `stamp` happens later.
        stamp = second + 0.2 * c / len(site.rig)
        true = stamp + float(site.clocks[c, 0] + site.clocks[c, 1] * stamp)
        pixels = marks(site.rig, site.start + true * site.velocity, site.errors.expand(len(site.start), -1))[:, c]
        depth = (site.start + true * site.velocity - site.rig.center[c]) @ site.rig.rotation[c, 2]
        there = site.rig.each[c].inside(pixels) & (depth > 0) & (torch.rand(len(pixels), generator=g) > MISSED)
        which = there.nonzero()[:, 0]
        false = int(torch.poisson(torch.tensor(FALSE), generator=g))
        # False detections are where true ones are: near the horizon.
        wrong = torch.rand(false, 2, generator=g).double() * torch.tensor([SIZE[0] - 40.0, 60.0]) + 20.0
        wrong[:, 1] += 520.0
        middle = torch.cat([pixels[which] + BOX_PX * torch.randn(len(which), 2, generator=g).double(), wrong])
        boxes = torch.cat([middle - 6.0, middle + 6.0], -1)
        owners.append(torch.cat([which, torch.full((false,), -1)]))
        names = ["object"] * len(middle)
        found = Detections(
            boxes=boxes, score=torch.ones(len(boxes)).double(), category=tuple(names), track=(None,) * len(boxes),
            size=SIZE, time=stamp,
        )  # fmt: skip
        seen.append(None if c == blind else found)
    return seen, owners


class Sums:
    """Counts and values over seeds."""

    def __init__(self) -> None:
        self.groups = self.right = self.doubtful = self.told = self.ghosts = self.breaks = 0
        self.given = self.well_given = 0
        self.followed = self.visible = 0.0
        self.nees: list[float] = []
        self.clocks: list[tuple[float, float]] = []
        self.milliseconds: list[float] = []


def run_seed(seed: int, count: int, seconds: float, sums: Sums) -> None:
    site, g = drawn_site(seed, count), torch.Generator().manual_seed(1000 + seed)
    localize = Localizer(site.rig)
    tracker = Tracker(localize, OPTIONS, clock=ClockPrior(offset_sigma_s=OFFSET_S, drift_sigma=RATE))
    options, names = AssociationOptions(box_sigma=BOX_PX), dict[int, int]()
    for second in np.arange(0.0, seconds):
        seen, owners = moment(site, float(second), seconds / 2, g)
        before = time.process_time()
        views = group_objects(localize, seen, options)
        tracks = tracker(views, float(second))
        sums.milliseconds.append(1e3 * (time.process_time() - before))
        _judge_groups(views, seen, owners, sums)
        if second < 10:
            continue
        places = site.start + float(second) * site.velocity
        enough = _seen_by(site, places) >= 2
        sums.visible += int(enough.sum())
        ok, state = tracks.state.status == 0, tracks.state
        followed = set()
        for row in ok.nonzero()[:, 0].tolist():
            error = places - state.enu[row]
            apart = (error * torch.linalg.solve(state.covariance[row], error.T).T).sum(-1)
            target = int(apart.argmin())
            sums.told += 1
            if float(apart[target]) > 50.0 and float(error[target].norm()) > 200.0:
                sums.ghosts += 1
                continue
            followed.add(target)
            number = tracks.number[row]
            key = next(record.key for record in tracker.records if record.number == number)
            for c in tracks.seen[row].nonzero()[:, 0].tolist():
                mark = views.pixels[tracker.seen_now[key, c], c]
                sums.given += 1
                sums.well_given += _owner(seen[c], owners[c], mark) == target
            if names.setdefault(target, number) != number:
                sums.breaks += 1
                names[target] = number
            if second % 10 == 0:
                sums.nees.append(float(apart[target]))
        sums.followed += len(followed & set(enough.nonzero()[:, 0].tolist()))
    for c in range(1, count):
        offset, sigma = tracker.clock_estimate(c).offset(seconds)
        sums.clocks.append((offset - float(site.clocks[c] @ torch.tensor([1.0, seconds]).double()), sigma))


def _owner(seen: Detections | None, owners: Tensor, mark: Tensor) -> int:
    """The target of a mark."""
    assert seen is not None
    return int(owners[(seen.anchors() - mark).abs().sum(-1).argmin()])


def _seen_by(site: Site, places: Tensor) -> Tensor:
    inside = site.rig(places)[1]
    return inside.sum(-1)


def _judge_groups(views: ObjectViews, seen: list[Detections | None], owners: list[Tensor], sums: Sums) -> None:
    for row in range(len(views)):
        if int(views.seen[row].sum()) < 2:
            continue
        if bool(views.ambiguous[row]):
            sums.doubtful += 1
            continue
        found = set()
        for c, each in enumerate(seen):
            if each is not None and bool(views.seen[row, c]):
                found.add(_owner(each, owners[c], views.pixels[row, c]))
        sums.groups += 1
        sums.right += len(found) == 1 and -1 not in found


@section("tracks.md", "station tracks", seeds=range(1), seconds=12.0, counts=(2,))
def station_tracks(seeds: range = range(8), seconds: float = 60.0, counts: tuple[int, ...] = (2, 3, 5)) -> Lines:
    yield (
        "12 targets (smokes, ships at 8 m/s, drones at 25 m/s) in 12 by 16 km, all of one category, once a second for "
        f"{seconds:g} s, {len(seeds)} draws; boxes {BOX_PX:g} px, {100 * MISSED:g} % missed, {FALSE:g} false an image; "
        f"attitude known to {ATTITUDE_DEG[0]}° and heading to {ATTITUDE_DEG[2]}°, clocks to {OFFSET_S} s and "
        f"{1e6 * RATE:g} ppm."
    )
    all_sums = [Sums() for _ in counts]
    for seed, (count, each) in itertools.product(seeds, zip(counts, all_sums, strict=True)):
        run_seed(seed, count, seconds, each)
    yield [
        "stations", "groups that are right", "marks of tracks that are right", "followed while two see it",
        "breaks a target and hour", "ghosts among tracks", "inside 95 %; median of χ² over its own",
        "clock at the end: RMS, inside 95 %", "CPU a moment",
    ]  # fmt: skip
    for count, s in zip(counts, all_sums, strict=True):
        nees, clocks = np.array(s.nees), np.array(s.clocks).reshape(-1, 2)
        hours = s.followed / 3600.0
        rms, stated = (1e3 * np.sqrt((clocks[:, i] ** 2).mean()) for i in (0, 1))
        good = int((np.abs(clocks[:, 0]) < 1.96 * clocks[:, 1]).sum())
        yield [
            count,
            f"{100 * s.right / max(s.groups, 1):.1f} % of {s.groups:,}; {s.doubtful:,} doubtful",
            f"{100 * s.well_given / max(s.given, 1):.1f} % of {s.given:,}",
            f"{100 * s.followed / max(s.visible, 1):.1f} %",
            f"{s.breaks / max(hours, 1e-9):.1f}",
            f"{100 * s.ghosts / max(s.told, 1):.1f} %",
            f"{100 * (nees < INSIDE_95).mean():.1f} % of {len(nees)}; {np.median(nees) / 2.366:.2f}",
            f"{rms:.0f} ms, stated {stated:.0f}; {good} of {len(clocks)}",
            f"{np.median(s.milliseconds):.0f} ms",
        ]  # fmt: skip


def crowd(targets: int, missed: float, false: int, seed: int) -> list[str]:
    """Targets in 8 cameras 8 km away, in one draw of the cameras' errors: a row of the table."""
    rig, g = ring(8, 8000.0), torch.Generator().manual_seed(seed)
    rig.root = rig.with_errors(position_m=POSITION_M, attitude_deg=ATTITUDE_DEG, refraction=REFRACTION)
    errors = drawn_errors(rig.root, 1, g).expand(targets, -1)
    spread = torch.tensor([2500.0, 2500.0, 400.0]).double()
    points = (torch.rand(targets, 3, generator=g).double() - 0.5) * 2 * spread + torch.tensor([0.0, 0.0, 700.0])
    localize, sums = Localizer(rig), Sums()
    tracker = Tracker(localize, OPTIONS)
    spent, marked, kept = [], 0, 0
    # Tracks of a thousand targets are not what is measured.
    moments = 2 if targets <= 100 else 1
    for number in range(moments):
        pixels = marks(rig, points, errors) + BOX_PX * torch.randn(targets, 8, 2, generator=g).double()
        inside = torch.stack([camera.inside(pixels[:, c]) for c, camera in enumerate(rig.each)], 1)
        inside &= torch.rand(inside.shape, generator=g) >= missed
        seen: list[Detections | None] = []
        owners = []
        for c in range(8):
            # False detections are where true ones are.
            wrong = torch.rand(false, 2, generator=g).double() * torch.tensor([1000.0, 200.0]) + 430.0
            middle = torch.cat([pixels[inside[:, c], c], wrong])
            seen.append(
                Detections.read(torch.cat([middle - 6, middle + 6], -1), size=SIZE, time=float(number), first_pixel=0.0)
            )
            owners.append(torch.cat([inside[:, c].nonzero()[:, 0], torch.full((false,), -1)]))
        before = time.process_time()
        views = group_objects(localize, seen, AssociationOptions(box_sigma=BOX_PX))
        middle_time = time.process_time()
        if moments > 1:
            tracker(views, float(number))
        spent.append((1e3 * (middle_time - before), 1e3 * (time.process_time() - middle_time)))
        if number == moments - 1:
            _judge_groups(views, seen, owners, sums)
            several = (views.seen.sum(1) > 1) & ~views.ambiguous
            marked, kept = int(inside.sum()), int(views.seen[several].sum())
    return [
        f"{targets:,}", f"{marked:,}; {100 * missed:g} % missed, {false} false an image", f"{spent[-1][0]:,.0f} ms",
        f"{sums.right:,}", f"{sums.groups - sums.right:,}", f"{sums.doubtful:,}", f"{kept:,}",
        f"{spent[-1][1]:,.0f} ms" if moments > 1 else "",
    ]  # fmt: skip


@section("tracks.md", "station speed", targets=(10,))
def speed(targets: tuple[int, ...] = (100, 1000)) -> Lines:
    """Targets in 8 cameras: CPU of grouping and of tracking them, and how many groups are right."""
    yield (
        "Targets in 5 by 5 km, .8 km high, 8 cameras around them in 8 km; one thread, one draw of the cameras' "
        "errors. A group is right if all its marks are of one thing."
    )
    yield [
        "targets", "marks of them in 8 cameras", "CPU of grouping", "right groups", "wrong groups", "doubtful groups",
        "marks in groups that are not doubtful", "CPU of the tracker",
    ]  # fmt: skip
    crowd(20, 0.0, 0, 0)
    for count in targets:
        for missed, false in ((0.0, 0), (0.15, 0), (0.15, count // 30)):
            yield crowd(count, missed, false, 0)
