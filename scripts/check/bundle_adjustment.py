"""Bundle adjustment in COLMAP and in GTSAM with kcal's prior, with free intrinsics and with fixed ones; truth known.

A traced lens or an `opencv4` lens is calibrated by kcal from eight simulated views of a board, and exported to each
program. Two scenes of 150 points 50 m away, marked within 0.5 px in eight images: "strip", parallel views down at a
relief of 5 m, which hardly determine focal length and radial terms; and "ring", views from all around, which do. The
same marks and starts are adjusted three times in each program. "Structure" is the RMS distance of the points from the
truth after the best similarity, in per mille of the 50 m; median over the seeds. Needs the wheels pycolmap, pyceres and
gtsam. Snippets of docs/howto/bundle-adjustment.md do the work, as they stand there.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from kcal import CalibrationOptions, Camera, calibrate_camera
from kcal.lens import export_cameras
from scripts.check.foreign_lenses import pycolmap_camera
from scripts.shared.page import Lines, section
from scripts.shared.simulated import simulated
from scripts.shared.views import observed, simulate

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "bundle-adjustment.md"
VIEWS, IMAGES, POINTS, HEIGHT, RELIEF, NOISE = 8, 8, 150, 50.0, 5.0, 0.5
WAYS = ("free", "fixed", "prior")
Project = Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]


class Scene(NamedTuple):
    """Poses (I, 3, 3), (I, 3) from the world, points (P, 3), pixels (I, P, 2) or NaN, and where points begin."""

    rotations: np.ndarray
    translations: np.ndarray
    points: np.ndarray
    pixels: np.ndarray
    start: np.ndarray


class Adjusted(NamedTuple):
    """Root mean square of the residuals, pixels, and the points (P, 3)."""

    reprojection: float
    points: np.ndarray


def snippet(number: int) -> str:
    """The code of the page, the first block for COLMAP and the second for GTSAM."""
    return re.findall(r"^```py\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)[number]


def strip(size: tuple[int, int], focal: float, draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotations, centers and points: images along x that overlap by three quarters, all looking down."""
    width, across = HEIGHT * size[0] / focal, HEIGHT * size[1] / focal
    centers = np.stack([0.25 * width * np.arange(IMAGES), np.zeros(IMAGES), np.zeros(IMAGES)], 1)
    points = np.stack([draw.uniform(-0.5 * width, centers[-1, 0] + 0.5 * width, POINTS),
                       draw.uniform(-0.5 * across, 0.5 * across, POINTS),
                       HEIGHT + draw.uniform(-0.5, 0.5, POINTS) * RELIEF], 1)  # fmt: skip
    return np.tile(np.eye(3), (IMAGES, 1, 1)), centers, points


def ring(size: tuple[int, int], focal: float, draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Likewise images from all around a heap of points, every second one turned by 90°."""
    radius = 0.4 * HEIGHT * size[1] / focal
    points = draw.uniform(-1.0, 1.0, (POINTS, 3)) * radius
    rotations, centers = [], []
    for number in range(IMAGES):
        angle = 2.0 * np.pi * number / IMAGES
        ahead = -np.array([np.cos(angle), np.sin(angle), 0.4])
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(ahead, right), ahead])
        rotations.append(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ axes if number % 2 else axes)
        centers.append(-HEIGHT * ahead)
    return np.array(rotations), np.array(centers), points


SCENES = {"strip": strip, "ring": ring}


def marked(kind: str, project: Project, camera: Camera, seed: int) -> Scene:
    """A scene as the true lens sees it, with noise; points seen less than three times are left out."""
    draw = np.random.default_rng(seed)
    rotations, centers, points = SCENES[kind](camera.size, float(camera.focal[0]), draw)
    translations = -np.einsum("iab,ib->ia", rotations, centers)
    there = np.einsum("iab,pb->ipa", rotations, points) + translations[:, None]
    seen, valid = project(torch.from_numpy(there).reshape(-1, 3))
    pixels = seen.reshape(IMAGES, POINTS, 2).numpy()
    inside = ((pixels > 0) & (pixels < np.array(camera.size) - 1)).all(-1) & valid.reshape(IMAGES, POINTS).numpy()
    pixels = np.where(inside[..., None], pixels + draw.normal(0.0, NOISE, pixels.shape), np.nan)
    often, start = inside.sum(0) >= 3, points + draw.normal(0.0, 0.2, points.shape)
    return Scene(rotations, translations, points[often], pixels[:, often], start[often])


def by_colmap(scene: Scene, camera: Camera, way: str, folder: Path) -> Adjusted:
    """COLMAP's bundle adjustment; pixels are those of kcal and half a pixel more."""
    import pycolmap

    done = export_cameras(camera, folder / "cameras.txt", format="colmap")
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(pycolmap_camera(done.paths[0], camera_id=1))
    for number, (rotation, translation) in enumerate(zip(scene.rotations, scene.translations, strict=True), 1):
        marks = np.nan_to_num(scene.pixels[number - 1] + 0.5, nan=-1.0)
        image = pycolmap.Image(
            f"{number}.png", pycolmap.Point2DList([pycolmap.Point2D(mark) for mark in marks]), 1, number
        )
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation))
    for index, point in enumerate(scene.start):
        track = pycolmap.Track()
        for number in range(IMAGES):
            if np.isfinite(scene.pixels[number, index, 0]):
                track.add_element(number + 1, index)
        reconstruction.add_point3D(point, track)
    config = pycolmap.BundleAdjustmentConfig()
    for number in range(1, IMAGES + 1):
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    if way == "fixed":
        config.set_constant_cam_intrinsics(1)
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, print_summary=False)
    options.ceres.solver_options.max_num_iterations = 200
    names: dict[str, Any] = {"options": options, "config": config, "reconstruction": reconstruction}
    if way == "prior":
        text = snippet(0).replace("cameras.prior.json", str(done.paths[1])).replace("0.5)", f"{NOISE})")
        exec(text, names)
    else:
        pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction).solve()
    ids = sorted(reconstruction.points3D)
    points = np.array([reconstruction.points3D[i].xyz for i in ids])
    squares, count = 0.0, 0
    for number in range(1, IMAGES + 1):
        seen = np.isfinite(scene.pixels[number - 1, :, 0])
        image = reconstruction.images[number]
        there = image.cam_from_world() * points[seen]
        shown = reconstruction.cameras[1].img_from_cam(there)
        squares += float(np.square(shown - 0.5 - scene.pixels[number - 1][seen]).sum())
        count += int(seen.sum())
    return Adjusted((squares / count) ** 0.5, points)


def by_gtsam(scene: Scene, camera: Camera, way: str, folder: Path) -> Adjusted:
    """GTSAM's Levenberg-Marquardt."""
    import gtsam

    done = export_cameras(camera, folder / "left.gtsam.json", format="gtsam")
    graph, values, key = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.symbol("k", 0)
    names: dict[str, Any] = {"graph": graph, "values": values, "key": key}
    exec(snippet(1).replace("left.gtsam.json", str(done.paths[0])), names)
    kind, lens = names["prior"]["model"], names["lens"]
    if way != "prior":
        graph.resize(0)
    noise = gtsam.noiseModel.Isotropic.Sigma(2, NOISE)
    factor = getattr(gtsam, f"GeneralSFMFactor2{kind}")
    world = [gtsam.Pose3(gtsam.Rot3(rotation), translation).inverse()
             for rotation, translation in zip(scene.rotations, scene.translations, strict=True)]  # fmt: skip
    for number, start in enumerate(world):
        pose = gtsam.symbol("x", number)
        values.insert(pose, start)
        for index in np.isfinite(scene.pixels[number, :, 0]).nonzero()[0]:
            graph.add(factor(scene.pixels[number, index], noise, pose, gtsam.symbol("p", int(index)), key))
    for index, point in enumerate(scene.start):
        values.insert(gtsam.symbol("p", index), point)
    first, second = gtsam.symbol("x", 0), gtsam.symbol("x", 1)
    exact = gtsam.noiseModel.Isotropic
    graph.add(gtsam.PriorFactorPose3(first, world[0], exact.Sigma(6, 1e-6)))
    distance = float(np.linalg.norm(world[1].translation() - world[0].translation()))
    graph.add(gtsam.RangeFactorPose3(first, second, distance, exact.Sigma(1, 1e-6)))
    if way == "fixed":
        graph.add(getattr(gtsam, f"PriorFactor{kind}")(key, lens, exact.Sigma(len(names["prior"]["mean"]), 1e-9)))
    elif way == "free":
        # GTSAM's lenses have a skew, which this camera has not.
        still = np.full(len(names["prior"]["mean"]), 1e6)
        still[2] = 1e-6
        graph.add(getattr(gtsam, f"PriorFactor{kind}")(key, lens, gtsam.noiseModel.Diagonal.Sigmas(still)))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    points = np.array([found.atPoint3(gtsam.symbol("p", index)) for index in range(len(scene.start))])
    fitted = getattr(found, f"at{kind}")(key)
    squares, count = 0.0, 0
    for number in range(IMAGES):
        camera_there = getattr(gtsam, f"PinholeCamera{kind}")(found.atPose3(gtsam.symbol("x", number)), fitted)
        for index in np.isfinite(scene.pixels[number, :, 0]).nonzero()[0]:
            squares += float(np.square(camera_there.project(points[index]) - scene.pixels[number, index]).sum())
            count += 1
    return Adjusted((squares / count) ** 0.5, points)


def structure(found: np.ndarray, truth: np.ndarray) -> float:
    """RMS distance after the best similarity (Umeyama, 1991), per mille of the height."""
    a, b = found - found.mean(0), truth - truth.mean(0)
    left, scale, right = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    turned = (scale * sign).sum() / np.square(a).sum() * a @ (left * sign @ right).T
    return 1e3 * float(np.sqrt(np.square(turned - b).sum(1).mean())) / HEIGHT


def cases(seed: int) -> dict[str, tuple[Project, Camera]]:
    """The true projections, and the cameras that kcal calibrated of them."""
    plain = Camera.build(focal=(1600, 1600), center=(963, 536), size=(1920, 1080),
                         coefficients=[-0.2, 0.06, 1e-3, -5e-4], model="opencv4")  # fmt: skip
    views = observed(simulate(VIEWS, plain, noise=0.2, seed=seed)["pixels"].tolist())
    held = calibrate_camera(views, CalibrationOptions(model="opencv4")).camera
    case = simulated(3 * seed + 1, VIEWS, 0.1, by_hand=False)
    return {"opencv4": (plain.project, held), "traced lens": (case.lens.project, calibrate_camera(case.seen).camera)}


@section("other-programs.md", "bundle adjustment", seeds=range(1))
def bundle_adjustment(seeds: range = range(10)) -> Lines:
    found: dict[tuple[str, str, str], list[list[tuple[float, float]]]] = {}
    with tempfile.TemporaryDirectory() as name:
        for seed in seeds:
            for lens, (project, camera) in cases(seed).items():
                for kind in SCENES:
                    scene = marked(kind, project, camera, seed)
                    for program, adjust in (("COLMAP", by_colmap), ("GTSAM", by_gtsam)):
                        done = [adjust(scene, camera, way, Path(name)) for way in WAYS]
                        figures = [(each.reprojection, structure(each.points, scene.points)) for each in done]
                        found.setdefault((lens, kind, program), []).append(figures)
    yield ["true lens", "scene", "program", *(f"{way}: reprojection, px" for way in WAYS),
           *(f"{way}: structure, ‰" for way in WAYS)]  # fmt: skip
    for key, values in found.items():
        reprojection, error = np.moveaxis(np.median(np.array(values), 0), -1, 0)
        yield [*key, *(f"{value:.3f}" for value in reprojection), *(f"{value:.3g}" for value in error)]
