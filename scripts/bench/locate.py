"""From pixels to positions, measured: speed beside OpenCV and kornia, coverage of the intervals, geodesy.

Within a round every side runs once, in turn; ratios are taken within a round: medians, below 1 kcal is
faster. The statistics are simulations with fixed seeds and do not depend on the machine.

*tables*: `kcal locate` on long tables, rows per second of processor time (user and system, so that other work on the
machine counts less) and peak memory, for each format. Each run is a process of its own with one thread, which locates a
table of one row first; of several runs the fastest counts.
"""

from __future__ import annotations

import math
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pyproj
import torch
from kornia.geometry.epipolar import triangulate_points
from torch import Tensor

from kcal import Localizer, Origin, Rig, save_rig
from kcal.lens.pose import rotation_from_vector
from kcal.lens.projection import project_components
from kcal.locate.angular import triangulate_linear, triangulate_pairs
from kcal.locate.geodesy import enu_to_geodetic
from kcal.locate.tabulate import circular_error
from kcal.rig import Mounting, RigCovariance, mounting_covariance
from scripts.shared.children import answer
from scripts.shared.long_range import ORIGIN, RANGES, rig
from scripts.shared.page import Lines, median, ratio, section, times

COUNTS = (100, 10_000, 1_000_000)


def poses() -> Tensor:
    """(2, 3, 4) of that rig."""
    there = rig()
    right = torch.cat([there.right_from_left_rotation, there.right_from_left_translation[:, None]], -1)
    return torch.stack([torch.eye(3, 4, dtype=torch.float64), right])


def some_points(count: int) -> Tensor:
    """Points 100 m to 5 km away, spread over the common view."""
    generator = torch.Generator().manual_seed(3)
    uniform = torch.rand(count, 3, dtype=torch.float64, generator=generator)
    depth = 100.0 * 50.0 ** uniform[:, 2:]
    return torch.cat([(uniform[:, :1] - 0.5) * depth * 0.8, (uniform[:, 1:2] - 0.5) * depth * 0.4, depth], -1)


def sides(points: Tensor, sigma: float) -> Tensor:
    """(N, 2, 2) coordinates on the plane z = 1 of both cameras, with noise."""
    cameras = poses()
    seen = torch.einsum("cij,nj->nci", cameras[:, :, :3], points) + cameras[:, :, 3]
    generator = torch.Generator().manual_seed(4)
    noise = torch.randn(len(points), 2, 2, dtype=torch.float64, generator=generator)
    return seen[..., :2] / seen[..., 2:] + sigma / 1600 * noise


@section("locate.md", "triangulation", rounds=1, points=COUNTS[:1])
@torch.no_grad()
def triangulation(rounds: int = 15, points: tuple[int, ...] = COUNTS) -> Lines:
    cameras = poses()
    pose = cameras[1, :, :3].contiguous(), cameras[1, :, 3].contiguous()
    P = cameras.numpy()
    torch.compiler.reset()
    compiled = torch.compile(triangulate_pairs, fullgraph=True, dynamic=True)
    yield [
        "points", "kcal closed form", "kcal compiled", "OpenCV", "kornia eigh", "kornia cofactor", "closed / OpenCV",
        "closed / cofactor",
    ]  # fmt: skip
    for count in points:
        flat = sides(some_points(count), 0.1)
        rays = torch.cat([flat, torch.ones(count, 2, 1, dtype=torch.float64)], -1)
        left, right = rays[:, 0].contiguous(), rays[:, 1].contiguous()
        arrays = [np.ascontiguousarray(flat[:, c].T.numpy()) for c in (0, 1)]
        pairs = flat[None, :, 0].contiguous(), flat[None, :, 1].contiguous()
        calls = [
            lambda: triangulate_pairs(left, right, pose),  # noqa: B023
            lambda: compiled(left, right, pose),  # noqa: B023
            lambda: cv2.triangulatePoints(P[0], P[1], *arrays),  # noqa: B023
            lambda: triangulate_points(cameras[:1], cameras[1:], *pairs),  # noqa: B023
            lambda: triangulate_points(cameras[:1], cameras[1:], *pairs, solver="cofactor"),  # noqa: B023
        ]
        found = times(calls, rounds)
        rate = [median([1e-6 * count / s for s in side], 2) for side in found]
        yield [f"{count:.0e}", *rate, ratio(found[0], found[2]), ratio(found[0], found[4])]


@section("locate.md", "accuracy")
@torch.no_grad()
def accuracy(count: int = 100_000) -> Lines:
    cameras = poses()
    P = cameras.numpy()
    point = torch.tensor([[300.0, -100.0, 5000.0]], dtype=torch.float64).expand(count, 3)
    yield ["at 5 km", "kcal closed form", "kcal singular values", "OpenCV", "kornia eigh", "kornia cofactor"]
    for name, sigma in (("0.1 px of noise: RMS error, m", 0.1), ("no noise: largest error, m", 0.0)):
        flat = sides(point, sigma)
        rays = torch.cat([flat, torch.ones(count, 2, 1, dtype=torch.float64)], -1)
        homogeneous = cv2.triangulatePoints(P[0], P[1], *(flat[:, c].T.numpy().copy() for c in (0, 1)))
        pairs = flat[None, :, 0], flat[None, :, 1]
        found = [
            triangulate_pairs(rays[:, 0], rays[:, 1], (cameras[1, :, :3], cameras[1, :, 3])).points,
            triangulate_linear(cameras, rays)[0],
            torch.as_tensor((homogeneous[:3] / homogeneous[3]).T),
            triangulate_points(cameras[:1], cameras[1:], *pairs)[0],
            triangulate_points(cameras[:1], cameras[1:], *pairs, solver="cofactor")[0],
        ]
        errors = [torch.linalg.vector_norm(each - point, dim=-1) for each in found]
        cells = [f"{float(e.square().mean().sqrt()):.4f}" if sigma else f"{float(e.max()):.1e}" for e in errors]
        yield [name, *cells]
    yield geodesy()


def known_to() -> RigCovariance:
    """Errors of a good calibration: some 0.05 px over the image, 0.001° of pose, 1 mm of baseline."""
    camera = torch.tensor([0.05, 0.05, 0.05, 0.05, 0.0, 3e-5, 3e-5, 1e-6, 1e-6, 1e-5], dtype=torch.float64)
    pose = torch.tensor([math.radians(1e-3)] * 3 + [1e-3] * 3, dtype=torch.float64)
    return RigCovariance.of(rig(), left=torch.diag(camera**2), right=torch.diag(camera**2), pose=torch.diag(pose**2))


def localizers() -> tuple[Localizer, Localizer]:
    """Of that rig without errors of its own, and with those of a good calibration."""
    placed = [rig().placed(origin=ORIGIN, heading_deg=35.0) for _ in range(2)]
    placed[1].covariance = known_to()
    return Localizer(placed[0], pixel_sigma=0.1), Localizer(placed[1], pixel_sigma=0.1)


@section("locate.md", "localizer", rounds=1, points=COUNTS[:1])
@torch.no_grad()
def localizer(rounds: int = 15, points: tuple[int, ...] = COUNTS) -> Lines:
    plain, known = localizers()
    yield ["points", "marks' noise given once", "a 4x4 covariance a point", "with the calibration's covariance"]
    for count in points:
        left, right = rig()(some_points(count))[0].unbind(-2)
        cov = (0.01 * torch.eye(4, dtype=torch.float64)).expand(count, 4, 4)
        found = times(
            [lambda: plain(left, right), lambda: plain(left, right, cov), lambda: known(left, right)],  # noqa: B023
            rounds,
        )
        rate = [median([1e-6 * count / s for s in side], 3) for side in found]
        yield [f"{count:.0e}", *rate]


@section("locate.md", "coverage", draws=400)
@torch.no_grad()
def coverage(draws: int = 40_000) -> Lines:
    """Simulated marks, and rigs drawn from their own covariance, at seven ranges."""
    there, (plain, wide) = rig(), localizers()
    factor, generator = known_to().half.T, torch.Generator().manual_seed(7)
    yield [
        "range, m", "marks only: interval", "CEP50", "CEP95", "RMS of range / bound", "with calibration: interval",
        "interval of marks alone, same rigs",
    ]  # fmt: skip
    for i, distance in enumerate(RANGES):
        angle = -0.3 + 0.1 * i
        point = distance * torch.tensor([[math.sin(angle), 0.02 * i - 0.06, math.cos(angle)]], dtype=torch.float64)
        point = point * (distance / torch.linalg.vector_norm(point))
        exact = torch.cat(there(point)[0].unbind(-2), -1)
        marks = exact + 0.1 * torch.randn(draws, 4, dtype=torch.float64, generator=generator)
        found = plain(marks[:, :2], marks[:, 2:])
        inside = (found.range_low <= distance) & (distance <= found.range_high)
        best = plain(exact[:, :2], exact[:, 2:])
        sample = slice(0, min(draws, 4000))
        radii = circular_error(found.enu[sample], found.covariance[sample])
        miss = torch.linalg.vector_norm((found.enu - best.enu)[sample, :2], dim=-1, keepdim=True)
        circles = (miss <= radii).double().mean(0).tolist()
        line = best.bearing[0]
        bound = float((line @ best.covariance[0] @ line).sqrt())
        range_rms = float((1.0 / found.inverse_range - distance).square().mean().sqrt())
        # The rig that was there, and the rig that is believed: the marks move by what they differ.
        moved = _marks_of_drawn_rigs(there, point, factor, draws, generator)
        noisy = moved + 0.1 * torch.randn(draws, 4, dtype=torch.float64, generator=generator)
        shares = []
        for module in (wide, plain):
            answer = module(noisy[:, :2], noisy[:, 2:])
            shares.append(((answer.range_low <= distance) & (distance <= answer.range_high)).double().mean().item())
        yield [
            f"{distance:.0f}", f"{100 * inside.double().mean().item():.2f} %",
            *(f"{100 * share:.1f} %" for share in circles), f"{range_rms / bound:.3f}",
            *(f"{100 * share:.2f} %" for share in shares),
        ]  # fmt: skip


def _marks_of_drawn_rigs(there: Rig, point: Tensor, factor: Tensor, draws: int, generator: torch.Generator) -> Tensor:
    """(draws, 4) exact marks in rigs whose parameters are drawn from the covariance."""
    steps = torch.randn(draws, factor.shape[1], dtype=torch.float64, generator=generator) @ factor.T
    cut = [there.left.values.shape[-1], there.right.values.shape[-1], 3, 3]
    left, right, turn, shift = steps.split(cut, -1)
    rotation = rotation_from_vector(turn) @ there.right_from_left_rotation
    in_right = (rotation @ point[0])[..., None] + (there.right_from_left_translation + shift)[..., None]
    in_left = point[0][:, None].expand(draws, 3, 1)
    pixels = [
        project_components(points, camera.values + step, camera.model).pixels[..., 0]
        for camera, step, points in ((there.left, left, in_left), (there.right, right, in_right))
    ]
    return torch.cat(pixels, -1)


def geodesy() -> str:
    worst = 0.0
    for lat in (-85.0, -45.0, 0.0, 19.07, 60.0, 85.0):
        for lon in (-180.0, -179.999, 0.0, 72.87, 179.999):
            pipeline = pyproj.Transformer.from_pipeline(
                "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
                f"+step +proj=topocentric +ellps=WGS84 +lat_0={lat!r} +lon_0={lon!r} +h_0=120.0"
            )
            for distance in (0.0, 100.0, 1000.0, 5000.0, 10_000.0):
                azimuth = torch.deg2rad(torch.arange(0, 360, 1, dtype=torch.float64))
                up = torch.linspace(-300, 600, len(azimuth), dtype=torch.float64)
                enu = torch.stack([distance * azimuth.sin(), distance * azimuth.cos(), up], -1)
                lats, lons, heights = enu_to_geodetic(enu, Origin(lat=lat, lon=lon, height=120.0)).numpy().T
                back = np.stack(pipeline.transform(lons, lats, heights), -1)
                worst = max(worst, float(np.abs(back - enu.numpy()).max()))
    return (
        "ENU to latitude, longitude, height by kcal and back by PROJ: largest difference "
        f"{worst:.1e} m (0 to 10 km, 360 azimuths, -85° to 85°, at and beside the antimeridian)."
    )


ROWS = (1_000, 1_000_000)
SUFFIXES = ("csv", "geojson", "geojsonl", "kml", "cot")
_RUN = """
import json, sys, time
from kcal.cli.main import main
rig, small, large, out = sys.argv[1:]
for points in (small, large):
    sys.argv = ["kcal", "locate", rig, points, "-o", out]
    start = time.process_time()
    try:
        main()
    except SystemExit as end:
        assert not end.code, end.code
from scripts.shared.page import peak_megabytes
print(json.dumps({"seconds": time.process_time() - start, "megabytes": peak_megabytes()}))
"""


def write_table(path: Path, count: int) -> Path:
    """Marks with 0.1 px of noise."""
    with torch.no_grad():
        left, right = rig()(some_points(count))[0].unbind(-2)
    marks = torch.cat([left, right], -1)
    marks += 0.1 * torch.randn(marks.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    with path.open("w") as file:
        file.write("name,left_u,left_v,right_u,right_v\n")
        for i, row in enumerate(marks.tolist()):
            file.write(f"p{i},{','.join(map(repr, row))}\n")
    return path


def _rows(folder: Path, suffixes: tuple[str, ...], counts: tuple[int, ...], repeat: int) -> Lines:
    """After a table of one row."""
    exact, known = rig(), rig()
    exact.mounting = Mounting(origin=ORIGIN, heading_deg=35.0)
    known.mounting = Mounting(
        origin=ORIGIN, heading_deg=35.0, covariance=mounting_covariance(origin_m=[0.05] * 3, attitude_deg=[0.005] * 3)
    )
    known.covariance = known_to()
    rigs = {"exact": save_rig(exact, folder / "exact.json"), "with covariances": save_rig(known, folder / "known.json")}
    tables = {count: write_table(folder / f"{count}.csv", count) for count in [1, *counts]}
    for suffix in suffixes:
        for name, path in rigs.items():
            if name != "exact" and suffix not in ("csv", "geojson"):
                continue
            out = folder / f"out.{suffix}"
            for count in counts:
                command = sys.executable, "-c", _RUN, path, tables[1], tables[count], out
                found = [answer(*command) for _ in range(repeat)]
                seconds, peak = min(each["seconds"] for each in found), max(each["megabytes"] for each in found)
                yield [f".{suffix}", name, f"{count:,}", f"{count / seconds:,.0f}", f"{peak:.0f}"]
                out.unlink()


@section("locate.md", "tables", rows=(1000,), formats=("csv",), repeat=1)
def tables(rows: tuple[int, ...] = ROWS, formats: tuple[str, ...] = SUFFIXES, repeat: int = 3) -> Lines:
    """Each format with each rig."""
    yield ["file", "rig", "rows", "rows a second of processor time", "peak MB"]
    with tempfile.TemporaryDirectory() as name:
        yield from _rows(Path(name), formats, rows, repeat)
