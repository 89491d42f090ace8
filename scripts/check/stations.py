"""Stations: triangulation beside other programs, coverage of the ellipses, crossing bearings, a real capture.

Other programs are used where they import: `pip install --no-deps aniposelib numba llvmlite jax jaxlib ml_dtypes
opt_einsum pose2sim rtoml c3d anytree` into a folder on PYTHONPATH. OpenCV and kornia triangulate two views; `cv2.sfm`
is in no wheel.

peers: cameras 5 m around a person-sized cloud (f 1,600 px, no distortion, so that nobody pays for undistortion), 1 px
of noise; views are missing at random, and 5 % of those that are seen are off by 30 to 200 px. Median error, 95th
percentile and share without a position; CPU seconds for a million points from so many as POINTS (a tenth for what
takes a Python loop).

coverage: stations `r` km from the targets; position 0.3 m, attitude 0.004° level and 0.02° heading, refraction 0.1,
clocks 0.05 s of targets that move 10 px/s, pixels 0.3 px, all drawn from what is stated; 95 % ellipsoids (χ², 3).

smoke: three towers; boxes around smoke 200 m wide, the middle 0.2 widths off its foot and the edges 5 px; headings
known to 0.2°. Cones: between the edges of each box, as pyronear crosses them; kcal is told the same boxes, with these
standard deviations.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from kcal import Camera, Localizer, Rig
from kcal.locate.stereo import Localization, PositionStatus
from kcal.locate.views import fit_views
from scripts.shared.page import DOCS, Lines, section, show, timed
from scripts.shared.real_captures import data_folder
from scripts.shared.station_scenes import drawn_errors, marks, ring, targets

OK = int(PositionStatus.OK)
_CHI2_95 = 7.814727903251179
Found = tuple[np.ndarray, float, int]
Solve = Callable[[np.ndarray], np.ndarray]


def around_a_person(count: int) -> Rig:
    """Cameras 5 m from the middle, all about it, looking at it from 2 m."""
    camera = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080), model="pinhole")
    turns, centers = [], []
    for c in range(count):
        angle = 2 * math.pi * (c + 0.3) / count
        center = torch.tensor([5 * math.cos(angle), 5 * math.sin(angle), 2.0], dtype=torch.float64)
        forward = torch.nn.functional.normalize(torch.tensor([0.0, 0, 1.0]).double() - center, dim=0)
        right = torch.nn.functional.normalize(torch.tensor([forward[1], -forward[0], 0.0]).double(), dim=0)
        turns.append(torch.stack([right, torch.linalg.cross(forward, right), forward]))
        centers.append(center)
    names = [f"c{c}" for c in range(count)]
    return Rig([camera] * count, names, torch.stack(turns), center=torch.stack(centers), refraction=0.0)


def spoiled(pixels: Tensor, missing: float, wrong: float, generator: torch.Generator) -> Tensor:
    """Marks with 1 px of noise, some of them missing (NaN, at least two are left), some wrong."""
    draw = torch.rand(pixels.shape[:2], generator=generator, dtype=torch.float64)
    order = draw.argsort(1).argsort(1)
    lost = (torch.rand(pixels.shape[:2], generator=generator) < missing) & (order >= 2)
    off = torch.rand(pixels.shape[:2], generator=generator) < wrong
    length = 30 + 170 * torch.rand(pixels.shape[:2], generator=generator, dtype=torch.float64)
    angle = 2 * math.pi * torch.rand(pixels.shape[:2], generator=generator, dtype=torch.float64)
    shift = torch.stack([angle.cos(), angle.sin()], -1) * length[..., None] * off[..., None]
    noisy = pixels + torch.randn(pixels.shape, generator=generator, dtype=torch.float64) + shift
    return torch.where(lost[..., None], math.nan, noisy)


def projections(rig: Rig) -> np.ndarray:
    """(C, 3, 4) K [R | t]."""
    shift = -(rig.rotation @ rig.center[..., None])
    matrices = torch.stack([camera.matrix for camera in rig.each]) @ torch.cat([rig.rotation, shift], -1)
    return matrices.detach().numpy()


def peers_of(rig: Rig) -> dict[str, tuple[Solve, int]]:
    """Functions from pixels (N, C, 2) to points (N, 3), and by how much fewer points they are timed on."""
    matrices, found = projections(rig), dict[str, tuple[Solve, int]]()
    shift = -(rig.rotation @ rig.center[..., None])
    checked = Localizer(rig, pixel_sigma=1.0)

    def ours(pixels: np.ndarray) -> np.ndarray:
        result: Localization = checked(torch.from_numpy(pixels))
        return np.where((result.status == OK).numpy()[:, None], result.enu.numpy(), np.nan)

    def views(pixels: np.ndarray) -> np.ndarray:
        marks = torch.from_numpy(pixels)
        fit = fit_views(checked.posed, marks, torch.isfinite(marks).all(-1), noise=1.0)
        ok = fit.fitted & (fit.fit.inverse > 0) & ~fit.behind(rig.center)
        return np.where(ok.numpy()[:, None], fit.points(ok).numpy(), np.nan)

    found["kcal `Localizer`"], found["kcal, no mark left out"] = (ours, 1), (views, 1)
    try:
        import cv2
        from aniposelib.cameras import Camera as OtherCamera  # type: ignore[import-not-found]
        from aniposelib.cameras import CameraGroup

        others = []
        for name, camera, turn, move in zip(rig.names, rig.each, rig.rotation, shift, strict=True):
            vector, _ = cv2.Rodrigues(turn.numpy())
            others.append(
                OtherCamera(camera.matrix.detach().numpy(), np.zeros(5), camera.size, vector, move.numpy(), name)
            )
        group = CameraGroup(others)
        found["aniposelib `triangulate`"] = lambda pixels: group.triangulate(pixels.transpose(1, 0, 2).copy()), 1
        found["aniposelib `triangulate_ransac`"] = (
            lambda pixels: group.triangulate_ransac(pixels.transpose(1, 0, 2).copy())[0], 50,
        )  # fmt: skip
    except ImportError:
        show(["aniposelib is not here"])
    try:
        from Pose2Sim.triangulation import triangulation_from_best_cameras  # type: ignore[import-not-found]

        settings = {"triangulation": {"reproj_error_threshold_triangulation": 15, "min_cameras_for_triangulation": 2}}

        def best(pixels: np.ndarray) -> np.ndarray:
            out = []
            for row in pixels:
                coordinates = row[:, 0], row[:, 1], np.where(np.isfinite(row[:, 0]), 1.0, np.nan)
                answer = triangulation_from_best_cameras(settings, coordinates, coordinates, list(matrices), {})
                out.append(np.asarray(answer[0], float)[:3])
            return np.array(out)

        found["Pose2Sim `triangulation_from_best_cameras`"] = (best, 50)
    except ImportError:
        show(["Pose2Sim is not here"])
    if len(rig) == 2:
        import cv2
        from kornia.geometry.epipolar import triangulate_points

        def opencv(pixels: np.ndarray) -> np.ndarray:
            points = cv2.triangulatePoints(matrices[0], matrices[1], pixels[:, 0].T, pixels[:, 1].T)
            return (points[:3] / points[3]).T

        def kornia(pixels: np.ndarray) -> np.ndarray:
            both = torch.from_numpy(pixels)
            first, second = torch.from_numpy(matrices)[:, None]
            return triangulate_points(first, second, both[None, :, 0], both[None, :, 1])[0].numpy()

        found["cv2 `triangulatePoints`"], found["kornia `triangulate_points`"] = (opencv, 1), (kornia, 1)
    return found


@section("stations.md", "peers", count=200)
@torch.no_grad()
def peers(count: int = 20_000) -> Lines:
    """Table of errors and times."""
    yield ["views", "missing", "wrong", "program", "median mm", "95 % mm", "no position", "CPU s per million"]
    for views, missing, wrong in (
        (2, 0.0, 0.0), (4, 0.0, 0.0), (8, 0.0, 0.0), (4, 0.1, 0.05), (8, 0.0, 0.05), (8, 0.1, 0.05), (8, 0.4, 0.05),
    ):  # fmt: skip
        rig, generator = around_a_person(views), torch.Generator().manual_seed(1)
        cloud = torch.randn(count, 3, generator=generator, dtype=torch.float64) * 0.3 + torch.tensor([0.0, 0, 1.0])
        exact, _ = rig(cloud)
        pixels = spoiled(exact, missing, wrong, generator).numpy()
        for name, (solve, fewer) in peers_of(rig).items():
            some = pixels[: max(count // fewer, 100)]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                # Compilers work once for each size.
                solve(some if fewer == 1 else some[:20])
                result, seconds = timed(solve, some)
            error = 1e3 * np.linalg.norm(result - cloud.numpy()[: len(some)], axis=1)
            none = ~np.isfinite(error)
            middle, high = np.quantile(error[~none], [0.5, 0.95])
            times = f"{none.mean():.1%}", f"{seconds / len(some) * 1e6:.1f}"
            yield [views, f"{missing:.0%}", f"{wrong:.0%}", name, f"{middle:.2f}", f"{high:.2f}", *times]


@section("stations.md", "coverage", draws=200)
@torch.no_grad()
def coverage(draws: int = 20_000) -> Lines:
    """Table of shares inside the 95 % ellipsoids."""
    yield ["distance", *(f"V = {views}" for views in range(2, 9))]
    for kilometers in (1, 5, 20):
        cells: list[object] = [f"{kilometers} km"]
        for views in range(2, 9):
            rig, generator = ring(views, 1e3 * kilometers), torch.Generator().manual_seed(views)
            root = rig.with_errors(position_m=0.3, attitude_deg=(0.004, 0.004, 0.02), refraction=0.1)
            points = targets(draws, generator, spread=60.0 * kilometers)
            seen = marks(rig, points, drawn_errors(root, draws, generator))
            velocity = 10.0 * torch.randn(seen.shape, generator=generator, dtype=torch.float64)
            late = 0.05 * torch.randn(draws, views, 1, generator=generator, dtype=torch.float64)
            seen = seen + velocity * late + 0.3 * torch.randn(seen.shape, generator=generator, dtype=torch.float64)
            found = Localizer(rig, pixel_sigma=0.3, root=root, clock_sigma=0.05)(seen, velocity=velocity)
            ok = found.status == OK
            error = (found.enu - points)[ok]
            squares = (error * torch.linalg.solve(found.covariance[ok], error)).sum(-1)
            sigma = found.covariance[ok].diagonal(dim1=-2, dim2=-1)[:, :2].sum(-1).sqrt().median()
            cells.append(f"{(squares < _CHI2_95).double().mean():.1%} ({float(sigma):.2g} m)")
        yield cells


def clipped(polygon: np.ndarray, normal: np.ndarray, offset: float) -> np.ndarray:
    """A convex polygon (N, 2) cut to where normal · x ≤ offset."""
    out, side = [], polygon @ normal - offset
    for a, b, p, q in zip(polygon, np.roll(polygon, -1, 0), side, np.roll(side, -1), strict=True):
        if p <= 0:
            out.append(a)
        if p * q < 0:
            out.append(a + (b - a) * p / (p - q))
    return np.array(out).reshape(-1, 2)


def area(polygon: np.ndarray) -> float:
    """Of a polygon, m²."""
    if len(polygon) < 3:
        return 0.0
    x, y = polygon.T
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


@section("stations.md", "smoke", draws=20)
@torch.no_grad()
def smoke(draws: int = 2000) -> Lines:
    """Table of crossing bearings."""
    yield [
        "distance", "cones contain it", "cones do not meet", "their area km²", "95 % ellipses contain it",
        "no position", "their area km²", "median error m",
    ]  # fmt: skip
    width, edge, shift, heading = 200.0, 5.0, 0.2, 0.2
    for kilometers in (5, 10, 20, 30):
        rig, generator = ring(3, 1e3 * kilometers), torch.Generator().manual_seed(kilometers)
        root = rig.with_errors(attitude_deg=(0.02, 0.02, heading), refraction=0.1)
        points = targets(draws, generator, spread=100.0 * kilometers)
        seen = marks(rig, points, drawn_errors(root, draws, generator))
        away = (points[:, None] - rig.center).norm(dim=-1)
        half = 0.5 * 1600.0 * width / away
        middle = seen[..., 0] + 2 * half * shift * torch.randn(half.shape, generator=generator, dtype=torch.float64)
        ends = torch.stack([middle - half, middle + half], -1)
        ends = ends + edge * torch.randn(ends.shape, generator=generator, dtype=torch.float64)
        box = torch.stack(
            [ends.mean(-1), seen[..., 1] + edge * torch.randn(half.shape, generator=generator).double()], -1
        )
        across = (2 * half * shift).square() + edge**2 / 2
        cov = torch.diag_embed(torch.stack([across, torch.full_like(across, edge**2)], -1))
        found = Localizer(rig, root=root)(box, cov=cov)
        ok = found.status == OK
        spread = found.covariance[:, :2, :2]
        error = (found.enu - points)[:, :2]
        known = torch.where(ok[:, None, None], spread, torch.eye(2))
        inside = (error * torch.linalg.solve(known, error)).sum(-1) < 5.991
        areas = math.pi * 5.991 * torch.linalg.det(spread[ok]).sqrt()
        hit, crossed = [], []
        for i in range(draws):
            polygon = 1e5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
            for c, (camera, turn) in enumerate(zip(rig.each, rig.rotation, strict=True)):
                rays, _ = camera.unproject(torch.stack([ends[i, c], torch.full((2,), 539.5).double()], -1))
                sides = (rays @ turn)[:, :2].numpy()
                for ray, sign in zip(sides, (1.0, -1.0), strict=True):
                    # Left and right of the cone, seen from above, clockwise.
                    normal = sign * np.array([-ray[1], ray[0]])
                    polygon = clipped(polygon, normal, float(normal @ rig.center[c, :2].numpy()))
                    if not len(polygon):
                        break
                if not len(polygon):
                    break
            crossed.append(area(polygon))
            there = points[i, :2].numpy()
            hit.append(len(polygon) > 2 and _contains(polygon, there))
        some = [one for one in crossed if one > 0]
        yield [
            f"{kilometers} km", f"{np.mean(hit):.0%}", f"{np.mean(np.array(crossed) == 0):.0%}",
            f"{np.median(some) / 1e6:.3f}" if some else "", f"{(inside & ok).double().mean():.1%}",
            f"{(~ok).double().mean():.0%}", f"{areas.median() / 1e6:.3f}",
            f"{float(error[ok].norm(dim=-1).median()):.0f}",
        ]  # fmt: skip


def _contains(polygon: np.ndarray, point: np.ndarray) -> bool:
    side, to = np.roll(polygon, -1, 0) - polygon, point - polygon
    cross = side[:, 0] * to[:, 1] - side[:, 1] * to[:, 0]
    return bool((cross >= 0).all() or (cross <= 0).all())


@section("stations.md", "real")
@torch.no_grad()
def real() -> Lines:
    """Table for the four cameras and the walking person: two cameras' points seen by the others."""
    data = np.load(data_folder() / "stations" / "pose2sim.npz")
    cameras = []
    for matrix, bends in zip(data["K"], data["D"], strict=True):
        cameras.append(
            Camera.build(
                focal=(matrix[0, 0], matrix[1, 1]), center=(matrix[0, 2], matrix[1, 2]), size=(1088, 1920),
                coefficients=bends.tolist(),
            )
        )  # fmt: skip
    turn, shift = torch.from_numpy(data["R"]), torch.from_numpy(data["t"])
    rig = Rig(cameras, list("abcd"), turn, center=-(turn.mT @ shift[..., None])[..., 0], refraction=0.0)
    keypoints = torch.from_numpy(data["keypoints"]).double().permute(0, 2, 1, 3)  # frames, joints, cameras, 3
    pixels, sure = keypoints[..., :2].reshape(-1, 4, 2), keypoints[..., 2].reshape(-1, 4)
    seen = (sure > 0.3) & torch.isfinite(pixels).all(-1)
    # The noise by which half of the joints that all four see have less than the median of χ² with 5 degrees.
    # Wide, so that no mark is left out.
    free = Localizer(rig, pixel_sigma=1e3)
    first = free(torch.where(seen[..., None], pixels, math.nan))
    four = (first.status == OK) & seen.all(-1)
    sigma = float((first.reprojection[four].square().sum(-1).median() / 4.351).sqrt())
    again, _ = rig(first.enu[four])
    off = (pixels[four] - again).mean(0).norm(dim=-1).tolist()
    note = f"{len(pixels)} joints; noise of a mark along an axis {sigma:.2f} px, from the joints that all four see; "
    offsets = ", ".join(f"{name} {one:.1f}" for name, one in zip(rig.names, off, strict=True))
    yield note + f"mean offset of a camera's marks: {offsets} px."
    yield ["cameras", "joints located", "of them a view left out", "contradictions", "RMS px", "held out, median px"]
    alone = [(f"without {name}", torch.arange(4) != c) for c, name in enumerate(rig.names)]
    for name, using in [("all four", torch.ones(4, dtype=torch.bool)), *alone]:
        found = Localizer(rig, pixel_sigma=sigma)(pixels, seen & using)
        ok = found.status == OK
        misses = (rig(found.enu)[0] - pixels).norm(dim=-1)
        own, torn = misses[found.used & ok[:, None]], found.status == int(PositionStatus.CONTRADICTION)
        held = misses[ok][seen[ok] & ~using]
        counts = [int(some.sum()) for some in (ok, found.bad.any(-1) & ok, torn)]
        median = f"{float(held.median()):.2f}" if len(held) else ""
        yield [name, *counts, f"{float(own.square().mean().sqrt()):.2f}", median]


@section("stations.md", "picture")
def picture(write: bool = False) -> None:
    """Towers and smoke, for the how-to page."""
    from kcal.locate.marks import Marks
    from kcal.locate.points import locate_points
    from kcal.report.figures import save_picture
    from kcal.report.positions import stations_figure

    rig, generator = ring(3, 12_000.0), torch.Generator().manual_seed(5)
    rig = Rig(
        rig.each,
        ("mill", "church", "mast"),
        rig.rotation,
        center=rig.center,
        origin=rig.origin,
        refraction=float(rig.refraction),
    )
    rig.root = rig.with_errors(attitude_deg=(0.05, 0.05, 0.3), refraction=0.1)
    points = torch.tensor([[-3500.0, 2500, 150], [1000, 0, 120], [4500, 3500, 200], [6000, -2500, 100]]).double()
    seen = marks(rig, points, drawn_errors(rig.root, 1, generator).expand(4, -1))
    seen = seen + 10.0 * torch.randn(seen.shape, generator=generator, dtype=torch.float64)
    seen[2, 1], seen[3, :2] = math.nan, math.nan
    views = Marks(("smoke 1", "smoke 2", "smoke 3", "smoke 4"), seen, sigma=torch.full((4, 3), 10.0).double())
    located = locate_points(rig, views)
    if write:
        save_picture(DOCS.parent / "howto" / "stations.png", stations_figure(located, points))
