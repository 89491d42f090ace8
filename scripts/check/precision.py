"""How exact kcal's functions are: largest errors against the same formulas in 50 digits, by quantity and dtype.

The references are written here from the published formulas, with mpmath; none of them calls kcal. Errors are the
largest over the points, so they grow slowly with `--points`. float32: what kcal returns for inputs rounded to float32,
against the exact value of the inputs that were not rounded. Lenses are drawn with a fixed seed.
"""

from __future__ import annotations

import datetime
import math
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import erfa
import mpmath
import numpy as np
import onnxruntime
import torch
from mpmath import mpf
from torch import Tensor

from kcal import Camera, InputError, Localizer, Origin, PositionStatus, Rig, load_camera, load_rig, save_camera
from kcal.lens import bake, rotation_from_vector, save_onnx, undistort_maps
from kcal.lens.views import new_pinhole
from kcal.locate import enu_to_geodetic, geodetic_to_enu
from kcal.stars.sky import Air, StarCatalog, observed_directions
from scripts.shared.page import Lines, section, table

Numbers = Sequence[mpf]
SIZE = (1920, 1080)
LENSES = {
    "opencv5": [-0.2, 0.05, 1e-3, -5e-4, -0.01],
    "opencv14": [0.31, -0.12, 4e-4, -3e-4, 0.004, 0.62, 0.05, 0.01, 1e-3, -4e-4, -6e-4, 2e-4, 0.03, -0.05],
    "fisheye4": [0.02, -0.004, 5e-4, -1e-4],
}
SAMPLE = Path(__file__).parents[2] / "assets" / "sample-rig.json"
PIXELS_OF = {"float64": torch.float64, "float32": torch.float32}
BASELINE, FOCAL, SIGMA = 10.0, 1600.0, 0.05
RANGES = (100.0, 1000.0, 5000.0, 50000.0)
mpmath.mp.dps = 50


def camera_of(name: str) -> Camera:
    return lens_of(LENSES[name], name)


def lens_of(coefficients: Sequence[float], model: str = "opencv5") -> Camera:
    return Camera.build(
        focal=(1400.0, 1405.0), center=(962.0, 538.0), size=SIZE, coefficients=coefficients, model=model
    )


def reference_pixel(point: Numbers, values: Numbers, model: str) -> tuple[mpf, mpf]:
    """Pixel of a point by OpenCV's published formulas; values: fx, fy, cx, cy, skew, then coefficients."""
    X, Y, Z = point
    fx, fy, cx, cy, skew, *c = values
    if model == "fisheye4":
        out = mpmath.sqrt(X * X + Y * Y)
        theta = mpmath.atan2(out, Z)
        t = theta * theta
        share = theta * (1 + t * (c[0] + t * (c[1] + t * (c[2] + t * c[3])))) / out if out else mpf(1) / Z
        x, y = X * share, Y * share
    else:
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tau_x, tau_y = [*c, *[mpf(0)] * (14 - len(c))]
        x, y = X / Z, Y / Z
        s = x * x + y * y
        g = (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
        u = g * x + 2 * p1 * x * y + p2 * (s + 2 * x * x) + s1 * s + s2 * s * s
        v = g * y + p1 * (s + 2 * y * y) + 2 * p2 * x * y + s3 * s + s4 * s * s
        # The tilt: rotation by tau_x, then tau_y, and the projection along the optical axis (OpenCV, calib3d).
        a, b, d, e = mpmath.cos(tau_x), mpmath.sin(tau_x), mpmath.cos(tau_y), mpmath.sin(tau_y)
        turn = mpmath.matrix([[d, 0, -e], [0, 1, 0], [e, 0, d]]) * mpmath.matrix([[1, 0, 0], [0, a, b], [0, -b, a]])
        keep = mpmath.matrix([[turn[2, 2], 0, -turn[0, 2]], [0, turn[2, 2], -turn[1, 2]], [0, 0, 1]])
        seen = keep * turn * mpmath.matrix([u, v, 1])
        x, y = seen[0] / seen[2], seen[1] / seen[2]
    return fx * x + skew * y + cx, fy * y + cy


def exactly(values: Tensor) -> list[mpf]:
    return [mpf(value) for value in values.double().tolist()]


def distance(a: Sequence[object], b: Sequence[object]) -> float:
    return float(mpmath.sqrt(sum((mpf(p) - mpf(q)) ** 2 for p, q in zip(a, b, strict=True))))


def draw_points(camera: Camera, count: int) -> Tensor:
    """Points of pixels all over the image, 0.1 m to 100 km away."""
    generator = torch.Generator().manual_seed(0)
    pixels = torch.rand(count, 2, generator=generator, dtype=torch.float64) * torch.tensor(SIZE) - 0.5
    away = 10 ** (6 * torch.rand(count, 1, generator=generator, dtype=torch.float64) - 1)
    rays, valid = camera.unproject(pixels)
    return (rays * away)[valid]


def lens_rows(count: int) -> Lines:
    """Projection, unprojection and derivatives of each lens."""
    for name in LENSES:
        camera = camera_of(name)
        values, points = exactly(camera.params.detach()), draw_points(camera, count)
        true = [reference_pixel(exactly(point), values, name) for point in points]
        off = {}
        for kind, dtype in PIXELS_OF.items():
            pixels, valid = camera.project(points.to(dtype))
            assert bool(valid.all())
            off[kind] = max(distance(pixel, wanted) for pixel, wanted in zip(pixels.tolist(), true, strict=True))
        yield [f"`project`, {name}, px", *shown(off)]
        exact_pixels = torch.tensor([[float(u), float(v)] for u, v in true], dtype=torch.float64)
        for kind, dtype in PIXELS_OF.items():
            rays, valid = camera.unproject(exact_pixels.to(dtype))
            assert bool(valid.all())
            again = [reference_pixel(exactly(ray), values, name) for ray in rays]
            off[kind] = max(distance(pixel, wanted) for pixel, wanted in zip(again, true, strict=True))
        yield [f"`unproject`, {name}, px of its ray's pixel", *shown(off)]
        yield from derivative_rows(camera, name, points[: max(1, count // 20)], values)


def derivative_rows(camera: Camera, name: str, points: Tensor, values: Numbers) -> list[list[str]]:
    """Derivatives of pixels by points and parameters, relative to the largest of each kind at the point."""
    live = Camera(camera.params.detach().clone(), size=SIZE, model=name).requires_grad_(True)
    errors = dict.fromkeys(("points", "parameters"), 0.0)
    for point in points:
        leaf = point[None].clone().requires_grad_(True)
        own: dict[str, list[Tensor]] = {"points": [], "parameters": []}
        for axis in (0, 1):
            by_point, by_values = torch.autograd.grad(live.project(leaf)[0][0, axis], [leaf, live.params])
            own["points"].append(by_point[0])
            own["parameters"].append(by_values)
        place = exactly(point)
        for kind, at in (("points", place), ("parameters", list(values))):
            found = torch.stack(own[kind])
            function = {
                "points": lambda p: reference_pixel(p, values, name),
                "parameters": lambda v: reference_pixel(place, v, name),  # noqa: B023
            }[kind]
            for column, true in enumerate(_slopes(function, at)):
                size = max(abs(value) for value in true) or mpf(1)
                gap = max(abs(mpf(a) - b) for a, b in zip(found[:, column].tolist(), true, strict=True))
                errors[kind] = max(errors[kind], float(gap / size))
    return [
        [f"derivatives of pixels by {kind}, {name}, relative", f"{error:.1e}", "–"] for kind, error in errors.items()
    ]


def _slopes(function: Callable[[Numbers], Sequence[mpf]], at: Numbers) -> list[list[mpf]]:
    """Central differences by each number in 50 digits, whose own error is some 1e-30."""
    step, columns = mpf(10) ** -17, []
    for axis in range(len(at)):
        ends = [function([*at[:axis], at[axis] + end, *at[axis + 1 :]]) for end in (step, -step)]
        columns.append([(a - b) / (2 * step) for a, b in zip(*ends, strict=True)])
    return columns


def table_rows(count: int) -> Lines:
    """What tables, maps, files and ONNX graphs keep of a camera."""
    camera = camera_of("opencv5")
    maps, flat = undistort_maps(camera), new_pinhole(camera)
    values, generator = exactly(camera.params.detach()), torch.Generator().manual_seed(1)
    worst = 0.0
    for u, v in (torch.rand(count, 2, generator=generator) * torch.tensor(SIZE)).long().tolist():
        fx, fy, cx, cy, *_ = exactly(flat.params.detach())
        wanted = reference_pixel([(u - cx) / fx, (v - cy) / fy, mpf(1)], values, "opencv5")
        worst = max(worst, distance((float(maps.map_x[v, u]), float(maps.map_y[v, u])), wanted))
    yield ["`undistort_maps`, float32 maps of 1920 columns, px", "–", f"{worst:.1e}"]
    hybrid = load_rig(SAMPLE).left
    for name, lens in (("opencv5", camera), ("default lens", hybrid)):
        baked, points = bake(lens, tolerance=1e-4), draw_points(camera, 10 * count)
        there, valid = baked.project(points)
        directions, known = lens.project_rays(points)
        gap = (there - directions)[valid & known].norm(dim=-1).max()
        yield [f"`bake` to 1e-4, {name}, px (stated {max(baked.bound):.1e})", f"{float(gap):.1e}", "–"]
        with tempfile.TemporaryDirectory() as folder, torch.no_grad():
            again = load_camera(save_camera(lens, Path(folder, "camera.json")))
            gap = (again.project(points)[0] - lens.project(points)[0]).abs().max()
            yield [f"`save_camera`, `load_camera`, {name}, px", f"{float(gap):.1e}", "–"]
            quiet = onnxruntime.SessionOptions()
            quiet.log_severity_level = 3
            session = onnxruntime.InferenceSession(save_onnx(lens, points[:4], Path(folder, "camera.onnx")), quiet)
            ran = torch.from_numpy(session.run(None, {session.get_inputs()[0].name: points.numpy()})[0])
            gap = (ran - lens.project(points)[0]).abs().max()
            yield [f"`save_onnx` in onnxruntime, {name}, px", f"{float(gap):.1e}", "–"]


def pair_rows(count: int) -> Lines:
    """Triangulation of exact pixels, and the sigma of the inverse range, of two unlike turned cameras."""
    left, right = (camera_of(name) for name in ("opencv5", "opencv14"))
    turn = rotation_from_vector(torch.tensor([0.01, -0.02, 0.015], dtype=torch.float64))
    center = torch.tensor([BASELINE, 0.3, -0.2], dtype=torch.float64)
    rig = Rig.pair(left, right, turn, -turn @ center)
    pair = Localizer(rig, pixel_sigma=SIGMA)
    matrix, shift = [exactly(line) for line in turn], exactly(-turn @ center)
    lefts, rights = exactly(left.params.detach()), exactly(right.params.detach())

    def seen(point: Numbers) -> list[mpf]:
        there = [mpmath.fdot(line, point) + t for line, t in zip(matrix, shift, strict=True)]
        return [*reference_pixel(point, lefts, "opencv5"), *reference_pixel(there, rights, "opencv14")]

    generator = torch.Generator().manual_seed(2)
    for away in RANGES:
        sideways = torch.rand(count // 4, 2, generator=generator, dtype=torch.float64) * 0.5 - 0.25
        ways = torch.cat([sideways, torch.ones(count // 4, 1)], -1)
        points = away * ways / ways.norm(dim=-1, keepdim=True)
        marks = [seen(exactly(point)) for point in points]
        pixels = torch.tensor([[float(value) for value in mark] for mark in marks], dtype=torch.float64)
        off, spread = {}, 0.0
        for kind, dtype in PIXELS_OF.items():
            found = pair(pixels[:, :2].to(dtype), pixels[:, 2:].to(dtype))
            assert int(found.status.max()) == 0
            off[kind] = float(((found.enu - points).norm(dim=-1) / away).max())
            if kind == "float64":
                for point, sigma in list(zip(points, found.inverse_range_sigma.tolist(), strict=True))[:5]:
                    spread = max(spread, abs(float(mpf(sigma) / _sigma(exactly(point), seen) - 1)))
        yield [f"`Localizer` at {away:,.0f} m, baseline 10 m, relative", *shown(off)]
        yield [f"its σ of the inverse range at {away:,.0f} m, relative to first order", f"{spread:.1e}", "–"]


def _sigma(point: Numbers, seen: Callable[[Numbers], list[mpf]]) -> mpf:
    """Standard deviation of one over the range, to first order, from the marks' noise alone."""
    rows = mpmath.matrix(_slopes(seen, point)).T
    covariance = mpf(SIGMA) ** 2 * (rows.T * rows) ** -1
    away = mpmath.sqrt(sum(value * value for value in point))
    slope = mpmath.matrix([-value / away**3 for value in point])
    return mpmath.sqrt((slope.T * covariance * slope)[0])


def reference_ecef(lat: mpf, lon: mpf, height: mpf) -> list[mpf]:
    """EPSG method 9602, WGS84."""
    major, flat = mpf(6378137), 1 / mpf("298.257223563")
    square, sine, cosine = flat * (2 - flat), mpmath.sin(mpmath.radians(lat)), mpmath.cos(mpmath.radians(lat))
    normal = major / mpmath.sqrt(1 - square * sine * sine)
    east, out = mpmath.radians(lon), (normal + height) * cosine
    return [out * mpmath.cos(east), out * mpmath.sin(east), ((1 - square) * normal + height) * sine]


def geodesy_rows(count: int) -> Lines:
    """ENU and geodetic coordinates, both ways, in meters, over the whole Earth."""
    generator = torch.Generator().manual_seed(3)
    for away in (1e3, 1e5, 1e7):
        worst = {"there": 0.0, "back": 0.0}
        for number in range(count // 4):
            draws = torch.rand(6, generator=generator, dtype=torch.float64)
            lat = (90.0, -90.0, 0.0)[number] if number < 3 else float(180 * draws[0] - 90)
            origin = Origin(lat=lat, lon=float(360 * draws[1] - 180), height=float(9500 * draws[2] - 500))
            enu = away * (2 * draws[3:] - 1) * torch.tensor([1.0, 1.0, 0.1])
            place = enu_to_geodetic(enu[None], origin)
            own = geodetic_to_enu(place, origin)
            a = reference_ecef(*exactly(place[0]))
            b = reference_ecef(mpf(origin.lat), mpf(origin.lon), mpf(origin.height))
            lat_mp, lon_mp = mpmath.radians(mpf(origin.lat)), mpmath.radians(mpf(origin.lon))
            s, c, e, n = mpmath.sin(lat_mp), mpmath.cos(lat_mp), mpmath.sin(lon_mp), mpmath.cos(lon_mp)
            axes = [[-e, n, mpf(0)], [-s * n, -s * e, c], [c * n, c * e, s]]
            true = [sum(k * (p - q) for k, p, q in zip(axis, a, b, strict=True)) for axis in axes]
            worst["there"] = max(worst["there"], distance(enu.tolist(), true))
            worst["back"] = max(worst["back"], distance(own[0].tolist(), true))
        yield [f"`enu_to_geodetic` to {away / 1e3:,.0f} km, m", f"{worst['there']:.1e}", "–"]
        yield [f"`geodetic_to_enu` to {away / 1e3:,.0f} km, m", f"{worst['back']:.1e}", "refused"]


def star_rows() -> Lines:
    """Directions of the bundled stars against ERFA's whole computation, in seconds of arc."""
    catalog = StarCatalog.bundled()
    for year, lat in ((2026, 52.0), (2026, -33.0), (1990, 0.0)):
        time = datetime.datetime(year, 3, 1, 3, 4, 5, tzinfo=datetime.UTC)
        place, air = Origin(lat=lat, lon=4.4, height=100.0), Air.at_height(100.0)
        own = observed_directions(catalog, time, place, air)
        day = erfa.dtf2d("UTC", year, 3, 1, 3, 4, 5.0)
        stars = catalog.ra, catalog.dec, catalog.pm_ra / np.cos(catalog.dec), catalog.pm_dec
        seat = math.radians(4.4), math.radians(lat), 100.0
        weather = air.hectopascal, air.celsius, air.humidity, 0.6
        azimuth, zenith, *_ = erfa.atco13(*stars, 0.0, 0.0, *day, 0.0, *seat, 0.0, 0.0, *weather)
        up = own[:, 2] > math.sin(math.radians(5.0))
        true = np.stack([np.sin(zenith) * np.sin(azimuth), np.sin(zenith) * np.cos(azimuth), np.cos(zenith)], -1)
        gap = np.linalg.norm(own - true, axis=-1)[up].max() * 206264.8
        name = f"`observed_directions` {year} at {lat:g}°, {up.sum():,} stars above 5°, seconds of arc"
        yield [name, f"{gap:.1e}", "–"]


def shown(errors: dict[str, float]) -> list[str]:
    return [f"{errors[kind]:.1e}" for kind in PIXELS_OF]


def limit_rows() -> list[list[str]]:
    """What is answered beyond the domain, asked now."""
    camera, folding = camera_of("opencv5"), lens_of([-0.9])
    wide = camera_of("fisheye4")
    pair = Localizer(Rig.pair(camera, camera, torch.eye(3), torch.tensor([-BASELINE, 0.0, 0.0])))
    middle = torch.tensor([[962.0, 538.0]], dtype=torch.float64)

    def mask(answer: tuple[Tensor, Tensor]) -> str:
        return "valid" if bool(answer[1].all()) else "not valid"

    def status(left: Tensor, right: Tensor) -> str:
        found = pair(left, right)
        return PositionStatus(int(found.status[0])).name

    def refusal(dtype: torch.dtype) -> str:
        try:
            camera.unproject(middle.to(dtype))
        except InputError:
            return "refused"
        return "accepted"

    shift = torch.tensor([[1.0, 0.0]], dtype=torch.float64)
    return [
        ["`project` of a point behind the camera", mask(camera.project(torch.tensor([[0.1, 0.0, -1.0]])))],
        ["`project` of a point in the plane of the camera", mask(camera.project(torch.tensor([[1.0, 0.0, 0.0]])))],
        ["`project` beyond the fold of a lens", mask(folding.project(torch.tensor([[0.7, 0.0, 1.0]])))],
        ["`unproject` of a pixel beyond the fold", mask(folding.unproject(torch.tensor([[1900.0, 538.0]])))],
        ["fisheye: `project` 100° off axis", mask(wide.project(torch.tensor([[1.0, 0.0, math.cos(1.7453)]])))],
        ["fisheye: `normalize` of a pixel beyond 89° off axis", mask(wide.normalize(torch.tensor([[3400.0, 538.0]])))],
        ["`project` of a point that is infinite or NaN", mask(camera.project(torch.tensor([[0.0, math.nan, 1.0]])))],
        ["`Localizer`, parallax below 3 σ", status(middle, middle - 0.5 * shift)],
        ["`Localizer`, parallel rays", status(middle, middle)],
        ["`Localizer`, diverging rays", status(middle, middle + 20 * shift)],
        ["`Localizer`, mark outside the image", status(middle * 3, middle)],
        *([f"pixels of {str(kind).removeprefix('torch.')}", refusal(kind)]
          for kind in (torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.int64)),
    ]  # fmt: skip


HEAD = ["quantity", "largest error, float64", "inputs of float32"]


@section("precision.md", "lens precision", points=20)
def lens_precision(points: int = 200) -> Lines:
    return table(HEAD, lens_rows(points))


@section("precision.md", "stored precision", points=20)
def stored_precision(points: int = 200) -> Lines:
    return table(HEAD, table_rows(points))


@section("precision.md", "position precision", points=20)
def position_precision(points: int = 200) -> Lines:
    return table(HEAD, [*pair_rows(points), *geodesy_rows(points), *star_rows()])


@section("precision.md", "limits")
def limits() -> Lines:
    return table(["what is asked", "answer"], limit_rows())
