"""Rigs from the scene itself: matches against the truth, yaw from one and ten pairs, ranges at 5 km.

    python -m scripts.check.scene matches yaw ranges speed picture [--seeds 30] [--write]

Pictures of one terrain by two traced lenses 10 m apart are rendered once (`scripts.shared.terrain_scene`), 1920 x 1080,
f 1600 px; noise, haze, blur and light come on top. `matches` compares what is found in them with the truth, beside
OpenCV's SIFT and USAC. `yaw` and `ranges` repeat the adjustment with many seeds: they take the places and covariances
of the matches of the rendered pair and draw the noise anew, since 30 renderings would take an hour. `speed`: CPU
seconds of the adjustment. With --write docs/measured/scene.md is made.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import math
import time
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.camera.calibrate import calibrate_camera
from kcal.calibrate.rig.result import RigResult
from kcal.calibrate.rig.solve import RigOptions, solve_rig
from kcal.calibrate.rig.sources import Baseline, Features, Landmarks, RigData
from kcal.corners.keypoints import keypoints
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import vector_from_rotation
from kcal.locate.localizer import StereoLocalizer
from kcal.scene.match import ImagePair, MatchedPair, match_scene, scene_of
from kcal.sim.backdrop import exposed
from kcal.sim.scene import demo_rig
from scripts.shared.long_range import ORIGIN
from scripts.shared.page import DOCS, write_section
from scripts.shared.terrain_scene import SKY, TerrainScene
from scripts.shared.timing import show
from scripts.shared.traced import as_camera, capture

TAPE = 0.005  # meters
MARK = 0.1  # px, of targets
WRONG = 2.0  # px
NAMES = ("left", "right")
CONDITIONS = {
    "clear": {},
    "haze, 4 km": {"haze": 4000.0},
    "dusk: a third of the light, noise 4": {"gain": 0.33, "noise": 4.0},
    "blur 1.4 px": {"blur": 1.4},
}
SCENE = TerrainScene(demo_rig(), 1)
RIG = SCENE.rig
EXACT = as_camera(RIG.left), as_camera(RIG.right)


def photographed(
    moment: int, *, haze: float = 1e12, gain: float = 1.0, noise: float = 1.5, blur: float = 0.7
) -> ImagePair:
    """A pair of images of a moment."""
    random, images = np.random.default_rng([1, moment]), []
    for picture in SCENE.pictures(moment):
        clear = np.exp(-np.minimum(picture.depth, 1e6) / haze)
        images.append(exposed(gain * (clear * picture.light + (1.0 - clear) * SKY), blur, noise, random))
    return ImagePair(f"{moment}", *images)


class Judged(NamedTuple):
    """Matches beside the truth.

    Attributes:
        number: of all.
        wrong: 2 px off, or of what moves.
        beside: of these, off the true epipolar line by more than 0.5 px: the others have a wrong range alone.
        across: px, RMS across the epipolar lines of those that are not wrong.
        sigmas: the same over their standard deviations.
        recall: share of all visible keypoints that were found.
    """

    number: int
    wrong: int
    beside: int
    across: float
    sigmas: float
    recall: float


def judged(pixels: Tensor, covariance: Tensor | None, moment: int, visible: int) -> Judged:
    """Compare matches (M, 2, 2) with the truth."""
    truth, _ = SCENE.true_right(pixels[:, 0], moment)
    off = pixels[:, 1] - truth
    near = pixels[:, 0].round().long()
    moving = torch.from_numpy(SCENE.pictures(moment)[0].moving)[near[:, 1], near[:, 0]]
    wrong = ~(torch.linalg.vector_norm(off, dim=-1) < WRONG) | moving
    good = off[~wrong, 1]
    sigmas = math.nan if covariance is None else float((good / covariance[~wrong, 1, 1].sqrt()).square().mean().sqrt())
    beside = wrong & (off[:, 1].abs() > 0.5)
    across, counts = float(good.square().mean().sqrt()), (len(pixels), int(wrong.sum()), int(beside.sum()))
    return Judged(*counts, across, sigmas, len(good) / visible)


def opencv_matches(pair: ImagePair) -> Tensor:
    """(M, 2, 2): SIFT, ratio test 0.75, both ways, USAC_MAGSAC on the fundamental matrix of undistorted pixels."""
    sift = cv2.SIFT_create()  # type: ignore[attr-defined]
    (first, one), (second, two) = (sift.detectAndCompute(image, None) for image in (pair.left, pair.right))
    matcher = cv2.BFMatcher()
    forth, back = matcher.knnMatch(one, two, k=2), matcher.knnMatch(two, one, k=1)
    kept = [m for m, n in forth if m.distance < 0.75 * n.distance and back[m.trainIdx][0].trainIdx == m.queryIdx]
    pixels = torch.tensor([[first[m.queryIdx].pt, second[m.trainIdx].pt] for m in kept], dtype=torch.float64)
    rays = [camera.unproject(pixels[:, k])[0] for k, camera in enumerate(EXACT)]
    flat = [(1600.0 * ray[:, :2] / ray[:, 2:]).numpy() for ray in rays]
    _, inside = cv2.findFundamentalMat(flat[0], flat[1], cv2.USAC_MAGSAC, 1.0, 0.9999, 10_000)
    return pixels[torch.from_numpy(np.asarray(inside)[:, 0] > 0)]


def visible_keypoints(pair: ImagePair, moment: int) -> int:
    """Keypoints of the left image that stand still and that the right camera sees."""
    left = keypoints(pair.left, 8000).pixels
    truth, _ = SCENE.true_right(left, moment)
    near, there = left.round().long(), truth.nan_to_num(-9.0).round().long()
    pictures = SCENE.pictures(moment)
    depth = [torch.from_numpy(picture.depth) for picture in pictures]
    width, height = RIG.right.size
    inside = (there >= 0).all(-1) & (there < torch.tensor([width, height])).all(-1)
    there = torch.where(inside[:, None], there, 0)
    same = (depth[1][there[:, 1], there[:, 0]] / depth[0][near[:, 1], near[:, 0]] - 1.0).abs() < 0.05
    moving = torch.from_numpy(pictures[0].moving)[near[:, 1], near[:, 0]]
    return int((inside & same & ~moving).sum())


@torch.no_grad()
def matches(_: int = 0) -> list[str]:
    """Matches under several conditions against the truth."""
    lines = show(
        [
            "| condition | by | matches | wrong | off the line | of visible | RMS across, px | over its σ | CPU s |",
            "|---|---|---|---|---|---|---|---|---|",
        ]
    )

    def told(condition: str, by: str, found: Judged, seconds: float) -> None:
        sigmas = "" if math.isnan(found.sigmas) else f"{found.sigmas:.2f}"
        lines.extend(show([
            f"| {condition} | {by} | {found.number} | {100 * found.wrong / found.number:.1f} % "
            f"| {100 * found.beside / found.number:.1f} % | {100 * found.recall:.0f} % "
            f"| {found.across:.3f} | {sigmas} | {seconds:.1f} |"
        ]))  # fmt: skip

    for condition, how in CONDITIONS.items():
        pairs = [photographed(moment, **how) for moment in (1, 2, 3)]
        visible = visible_keypoints(pairs[0], 1)
        start = time.process_time()
        try:
            found = [match_scene(EXACT, pair) for pair in pairs]
        except InputError:
            lines.extend(show([f"| {condition} | kcal | refused | | | | | | |"]))
        else:
            seconds = (time.process_time() - start) / 3
            told(condition, "kcal, one pair", judged(found[0].pixels, found[0].covariance, 1, visible), seconds)
            scene = scene_of(EXACT, pairs, found)
            seconds = (time.process_time() - start) / 3
            own = slice(0, scene.counts[0].used)
            assert scene.features.covariance is not None
            of_three = judged(scene.features.pixels[own], 2.0 * scene.features.covariance[own, 0], 1, visible)
            told(condition, "kcal, three pairs", of_three, seconds)
        start = time.process_time()
        pixels = opencv_matches(pairs[0])
        told(condition, "OpenCV SIFT + USAC", judged(pixels, None, 1, visible), time.process_time() - start)
    return lines


@functools.cache
def measured() -> tuple[Tensor, Tensor, Tensor]:
    """Left pixels (M, 2), true right pixels and covariances (M, 2, 2) of a rendered pair's still matches."""
    pairs = [photographed(moment) for moment in (1, 2)]
    found: list[MatchedPair] = [match_scene(EXACT, pair) for pair in pairs]
    scene = scene_of(EXACT, pairs, found)
    own = slice(0, scene.counts[0].used)
    left = scene.features.pixels[own, 0]
    truth, _ = SCENE.true_right(left, 1)
    assert scene.features.covariance is not None
    good = torch.linalg.vector_norm(truth - scene.features.pixels[own, 1], dim=-1) < WRONG
    return left[good], truth[good], 2.0 * scene.features.covariance[own, 0][good]


def drawn(places: tuple[Tensor, Tensor, Tensor], pairs: int, draw: torch.Generator, wrong: float = 0.01) -> Features:
    """Matches of some pairs with noise of the measured covariance, a share of them wrong by some px."""
    left, right, covariance = (torch.cat([part] * pairs) for part in places)
    noise = torch.randn(right.shape, dtype=torch.float64, generator=draw)
    right = right + (torch.linalg.cholesky(covariance) @ noise[..., None])[..., 0]
    bad = torch.rand(len(right), generator=draw) < wrong
    right[bad] += 3.0 * torch.randn(int(bad.sum()), 2, dtype=torch.float64, generator=draw)
    nothing = torch.zeros(len(left), dtype=torch.float64)
    return Features(
        names=tuple(map(str, range(len(left)))), pixels=torch.stack([left, right], 1), inverse_range=nothing,
        inverse_range_sigma=torch.full_like(nothing, torch.inf),
        covariance=0.5 * covariance[:, None].expand(-1, 2, 2, 2),
    )  # fmt: skip


def rig_data(cameras: tuple[Camera, Camera], features: Features, draw: torch.Generator) -> RigData:
    length = float(RIG.baseline) + TAPE * float(torch.randn((), generator=draw))
    tape = Baseline(first=0, second=1, length=length, sigma=TAPE)
    return RigData(cameras=cameras, names=NAMES, features=features, baselines=(tape,))


@torch.no_grad()
def yaw(seeds: int) -> list[str]:
    """Yaw from one and ten pairs with exact lenses, whose σ is the Cramér-Rao bound of these matches."""
    places = measured()
    lines = show(
        [
            "| pairs | matches | σ of yaw (the bound) | RMS error | over σ | inside 95 % | CPU s |",
            "|---|---|---|---|---|---|---|",
        ]
    )
    for pairs in (1, 10):
        errors, sigmas, seconds, count = [], [], 0.0, 0
        for seed in range(seeds if pairs == 1 else max(seeds // 2, 1)):
            draw = torch.Generator().manual_seed(seed)
            features = drawn(places, pairs, draw)
            start = time.process_time()
            found = solve_rig(rig_data(EXACT, features, draw), RigOptions(intrinsics="fixed"))
            seconds += time.process_time() - start
            relative = found.rotation[1] @ found.rotation[0].T @ RIG.right_from_left_rotation.T
            errors.append(math.degrees(float(vector_from_rotation(relative)[1])))
            sigmas.append(math.degrees(float(found.relative_covariance(0, 1)[1, 1].sqrt())))
            count = len(features.names)
        error, sigma = torch.tensor(errors), torch.tensor(sigmas)
        inside = float(((error / sigma).abs() < 1.96).double().mean())
        lines += show([
            f"| {pairs} | {count} | {float(sigma.mean()):.5f}° | {float(error.square().mean().sqrt()):.5f}° "
            f"| {float((error / sigma).square().mean().sqrt()):.2f} | {100 * inside:.0f} % of {len(errors)} "
            f"| {seconds / len(errors):.1f} |"
        ])  # fmt: skip
    return lines


def landmarks(draw: torch.Generator) -> Landmarks:
    """Twelve surveyed landmarks 100 m to 2.6 km away, in the left camera's frame turned to east, north, up."""
    count = 12
    share = torch.rand(20 * count, 3, dtype=torch.float64, generator=draw)
    distance = 100.0 * 26.0 ** share[:, :1]
    ray = torch.stack([1.0 * (share[:, 1] - 0.5), 0.4 * (share[:, 2] - 0.5), torch.ones_like(share[:, 0])], -1)
    points = distance * ray / ray.norm(dim=-1, keepdim=True)
    left, right, valid = RIG(points)
    seen = (valid & RIG.left.inside(left) & RIG.right.inside(right)).nonzero()[:count, 0]
    pixels = torch.stack([left, right], 1)[seen]
    enu = points[seen] @ torch.tensor([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]], dtype=torch.float64)
    survey = 0.02 * torch.randn(count, 3, dtype=torch.float64, generator=draw)
    marks = MARK * torch.randn(count, 2, 2, dtype=torch.float64, generator=draw)
    return Landmarks(
        names=tuple(f"post {i}" for i in range(count)), points=enu + survey, sigma=torch.full_like(survey, 0.02),
        pixels=pixels + marks, pixel_sigma=MARK,
    )  # fmt: skip


def at_five_km(found: RigResult, draw: torch.Generator) -> tuple[Tensor, Tensor]:
    """Relative errors (T,) of ranges at 5 km of marked targets, and their σ."""
    angle = torch.linspace(-0.4, 0.4, 9, dtype=torch.float64)
    ray = torch.stack([angle.sin(), 0.02 * torch.arange(9) - 0.08, angle.cos()], -1)
    ray = 5000.0 * ray / ray.norm(dim=-1, keepdim=True)
    left, right, _ = RIG(ray)
    noise = MARK * torch.randn(2, 9, 2, dtype=torch.float64, generator=draw)
    where = StereoLocalizer(found.stereo(), origin=ORIGIN, heading_deg=0.0, pixel_sigma=MARK)(
        left + noise[0], right + noise[1]
    )
    return 5000.0 * where.inverse_range - 1.0, 5000.0 * where.inverse_range_sigma


@torch.no_grad()
def ranges(seeds: int) -> list[str]:
    """Ranges at 5 km with calibrated lenses: from landmarks, from the scene, from both."""
    places = measured()
    lines = show(
        ["| corners, px | from | RMS error at 5 km | mean σ | over σ | inside 95 % |", "|---|---|---|---|---|---|"]
    )
    straight = RigOptions(refraction=0.0, refraction_sigma=0.0)
    for corner in (0.05, 0.2):
        rows: dict[str, list[tuple[Tensor, Tensor]]] = {}
        for seed in range(seeds):
            draw = torch.Generator().manual_seed(1000 + seed)
            cameras = tuple(
                calibrate_camera(capture(lens, 30, corner, 2 * seed + k)).camera
                for k, lens in enumerate((RIG.left, RIG.right))
            )
            scene = rig_data((cameras[0], cameras[1]), drawn(places, 1, draw), draw)
            survey = landmarks(draw)
            alone = RigData(cameras=scene.cameras, names=NAMES, landmarks=survey)
            both = dataclasses.replace(scene, landmarks=survey)
            for name, data in (("12 landmarks", alone), ("one pair and a tape", scene), ("both", both)):
                rows.setdefault(name, []).append(at_five_km(solve_rig(data, straight), draw))
        for name, found in rows.items():
            error, sigma = (torch.cat(part) for part in zip(*found, strict=True))
            z = error / sigma
            each = torch.stack([(e / s).abs() < 1.96 for e, s in found]).double().mean(1)
            spread = float(each.std() / math.sqrt(len(each))) if len(each) > 1 else math.nan
            lines += show([
                f"| {corner} | {name} | {100 * float(error.square().mean().sqrt()):.1f} % "
                f"| {100 * float(sigma.mean()):.1f} % | {float(z.square().mean().sqrt()):.2f} "
                f"| {100 * float((z.abs() < 1.96).double().mean()):.0f} ± {100 * spread:.0f} % |"
            ])  # fmt: skip
    return lines


@torch.no_grad()
def speed(_: int = 0) -> list[str]:
    """CPU seconds of the adjustment with calibrated lenses."""
    cameras = tuple(calibrate_camera(capture(lens, 20, 0.05, k)).camera for k, lens in enumerate((RIG.left, RIG.right)))
    lines = show(["| matches | CPU s |", "|---|---|"])
    for count in (2000, 20_000):
        draw = torch.Generator().manual_seed(1)
        share = torch.rand(6 * count, 3, dtype=torch.float64, generator=draw)
        points = (
            50.0 * 400.0 ** share[:, :1] * RIG.left.unproject(share[:, 1:] * (torch.tensor(RIG.left.size) - 1.0))[0]
        )
        left, right, valid = RIG(points)
        seen = (valid & RIG.left.inside(left) & RIG.right.inside(right)).nonzero()[:count, 0]
        places = left[seen], right[seen], torch.full((len(seen), 1, 1), 0.02).double() * torch.eye(2).double()
        data = rig_data((cameras[0], cameras[1]), drawn(places, 1, draw, 0.03), draw)
        start = time.process_time()
        solve_rig(data)
        lines += show([f"| {count} | {time.process_time() - start:.1f} |"])
    return lines


def picture() -> None:
    """Matches of a pair on the left image, by their range: docs/howto/scene.png."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    pairs = [photographed(moment) for moment in (1, 2)]
    scene = scene_of(EXACT, pairs, [match_scene(EXACT, pair) for pair in pairs])
    left = scene.features.pixels[: scene.counts[0].used, 0]
    _, distance = SCENE.true_right(left, 1)
    figure, axes = plt.subplots(figsize=(9.6, 5.6), layout="constrained")
    axes.imshow(pairs[0].left, cmap="gray", vmin=0, vmax=255)
    dots = axes.scatter(
        left[:, 0].numpy(),
        left[:, 1].numpy(),
        s=5,
        c=distance,
        cmap="turbo",
        norm=matplotlib.colors.LogNorm(30, 20_000),
    )
    bar = figure.colorbar(dots, ax=axes, label="range, m", shrink=0.8)
    bar.set_ticks([50, 100, 500, 1000, 5000, 20_000], labels=["50", "100", "500", "1000", "5000", "20000"])
    axes.set(xlabel="u, px", ylabel="v, px", title=f"{len(left)} matches of one pair of images")
    figure.savefig(DOCS.parent / "howto" / "scene.png", dpi=100)


_PARTS: dict[str, Callable[[int], list[str]]] = {"matches": matches, "yaw": yaw, "ranges": ranges, "speed": speed}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="+", choices=("matches", "yaw", "ranges", "speed", "picture"))
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    for part in given.parts:
        if part == "picture":
            picture()
            continue
        lines = _PARTS[part](given.seeds)
        if given.write:
            write_section("scene.md", part, "\n".join(lines))


if __name__ == "__main__":
    main()
