"""Rigs from the scene itself: matches against the truth, yaw from one and ten pairs, ranges at 5 km.

Pictures of a terrain (`scripts.shared.terrain`) by two traced lenses. `yaw`: each seed is another terrain, and its
ten pairs of a minute and of a day are rendered and matched; --scale makes the pictures smaller (1: 1920 x 1080, f 1600
px) and so affordable. `matches`: what is found under several conditions, beside OpenCV's SIFT and USAC. `common`:
errors that matches share. `ranges`: places and covariances are those of one rendered pair, and errors are drawn anew
for each seed. `speed`: CPU seconds of the adjustment.

`repeats`: which errors of matches repeat, and what they do to yaw. Each seed is a terrain (960 x 540) of exact lenses.
Keypoints are matched along the true epipolar lines of pictures with noise, and refined in these and in the same without
noise: what then is left comes again in every pair of that light. Weights are those of noise and of 0.08 px.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import pickle
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
import torch
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from torch import Tensor

from kcal import Baseline, Camera, Features, InputError, Landmarks, RigData, RigOptions, calibrate_camera, solve_rig
from kcal.calibrate.rig.result import RigResult
from kcal.corners.match import keypoints
from kcal.lens.pose import vector_from_rotation
from kcal.lens.rig import Rig
from kcal.locate.localizer import Localizer
from kcal.scene.common_errors import line_errors, with_common_errors
from kcal.scene.match import ImagePair, MatchedPair, counted, guided_matches, match_scene, scene_of, still_matches
from kcal.scene.match import _posed as posed
from kcal.scene.refine import refine_matches
from kcal.sim.captures import TrueRig, drawn_rig
from kcal.sim.raytrace import SURVEILLANCE
from kcal.sim.scene import FOCAL_MM
from scripts.shared.captures import as_camera, capture
from scripts.shared.long_range import ORIGIN, landmarks_of, matches_of, with_noise
from scripts.shared.page import DOCS, NOT_KEPT, Kept, Lines, Record, rms, section, share, table, timed
from scripts.shared.terrain import Terrain, Weather

TAPE = 0.005  # meters
MARK = 0.1  # px, of targets
WRONG = 2.0  # px
NAMES = ("left", "right")
NOON = Weather()
# Three moments each.
CONDITIONS: dict[str, tuple[Weather, ...]] = {
    "clear noon": (NOON,) * 3,
    "haze, 4 km": (Weather(haze=4000.0),) * 3,
    "low sun, 17 h": (Weather(hour=17.0),) * 3,
    "dusk, 18.5 h, noise 4": (Weather(hour=18.5, noise=4.0),) * 3,
    "blur 1.4 px": (Weather(blur=1.4),) * 3,
    "masts turn by 1 mrad in a rolling shutter": (Weather(shutter=1e-3),) * 3,
    "12, 9 and 16 h": (NOON, Weather(hour=9.0), Weather(hour=16.0)),
    "two seasons": (NOON, Weather(season=0.5), Weather(season=1.0)),
}


@functools.cache
def rig_of(scale: float) -> TrueRig:
    return drawn_rig(SURVEILLANCE, 1.0, 1, focal_mm=FOCAL_MM, wander=1.0, scale=scale)


@functools.cache
def exact(scale: float) -> tuple[Camera, Camera]:
    rig = rig_of(scale)
    return as_camera(rig.left), as_camera(rig.right)


RIG = rig_of(1.0)
# Pictures of `matches`.
HALF = 0.5
SCENE = Terrain(rig_of(HALF), 1)


def photographed(terrain: Terrain, moment: int, weather: Weather = NOON) -> ImagePair:
    """A pair of images of a moment."""
    return ImagePair(f"{moment}", *terrain.images(moment, weather))


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


def judged(pixels: Tensor, covariance: Tensor | None, moment: int, weather: Weather, visible: int) -> Judged:
    """Compare matches (M, 2, 2) with the truth."""
    truth, _ = SCENE.true_right(pixels[:, 0], moment, weather)
    off = pixels[:, 1] - truth
    near = pixels[:, 0].round().long()
    moving = torch.from_numpy(SCENE.picture(0, moment, weather).moving)[near[:, 1], near[:, 0]]
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
    rays = [camera.unproject(pixels[:, k])[0] for k, camera in enumerate(exact(HALF))]
    flat = [(1600.0 * HALF * ray[:, :2] / ray[:, 2:]).numpy() for ray in rays]
    _, inside = cv2.findFundamentalMat(flat[0], flat[1], cv2.USAC_MAGSAC, 1.0, 0.9999, 10_000)
    return pixels[torch.from_numpy(np.asarray(inside)[:, 0] > 0)]


def visible_keypoints(pair: ImagePair, moment: int, weather: Weather) -> int:
    """Keypoints of the left image that stand still and that the right camera sees."""
    left = keypoints(pair.left, 8000).pixels
    truth, _ = SCENE.true_right(left, moment, weather)
    near, there = left.round().long(), truth.nan_to_num(-9.0).round().long()
    pictures = [SCENE.picture(side, moment, weather) for side in (0, 1)]
    depth = [torch.from_numpy(picture.depth) for picture in pictures]
    width, height = SCENE.rig.right.size
    inside = (there >= 0).all(-1) & (there < torch.tensor([width, height])).all(-1)
    there = torch.where(inside[:, None], there, 0)
    same = (depth[1][there[:, 1], there[:, 0]] / depth[0][near[:, 1], near[:, 0]] - 1.0).abs() < 0.05
    moving = torch.from_numpy(pictures[0].moving)[near[:, 1], near[:, 0]]
    return int((inside & same & ~moving).sum())


def told(condition: str, by: str, found: Judged, seconds: float) -> list[object]:
    sigmas = "" if math.isnan(found.sigmas) else f"{found.sigmas:.2f}"
    return [
        condition, by, found.number, f"{100 * found.wrong / found.number:.1f} %",
        f"{100 * found.beside / found.number:.1f} %", f"{100 * found.recall:.0f} %", f"{found.across:.3f}", sigmas,
        f"{seconds:.1f}",
    ]  # fmt: skip


@section("scene.md", "matches", conditions=("clear noon",))
@torch.no_grad()
def matches(conditions: tuple[str, ...] = tuple(CONDITIONS)) -> Lines:
    """Matches under several conditions against the truth."""
    yield ["condition", "by", "matches", "wrong", "off the line", "of visible", "RMS across, px", "over its σ", "CPU s"]
    for condition, weathers in ((name, CONDITIONS[name]) for name in conditions):
        # The first last: its pictures are then at hand.
        pairs = [photographed(SCENE, moment, weathers[moment - 1]) for moment in (3, 2, 1)][::-1]
        visible = visible_keypoints(pairs[0], 1, weathers[0])
        start = time.process_time()
        try:
            found = [match_scene(exact(HALF), pair) for pair in pairs]
        except InputError:
            yield [condition, "kcal", "refused", *[""] * 6]
        else:
            seconds = (time.process_time() - start) / 3
            one = judged(found[0].pixels, found[0].covariance, 1, weathers[0], visible)
            yield told(condition, "kcal, one pair", one, seconds)
            scene = scene_of(exact(HALF), pairs, found)
            seconds = (time.process_time() - start) / 3
            own = slice(0, scene.counts[0].used)
            of_three = judged(scene.features.pixels[own], None, 1, weathers[0], visible)
            yield told(condition, "kcal, three pairs", of_three, seconds)
        pixels, spent = timed(opencv_matches, pairs[0])
        yield told(condition, "OpenCV SIFT + USAC", judged(pixels, None, 1, weathers[0], visible), spent)


@functools.cache
def measured() -> tuple[Tensor, Tensor, Tensor]:
    """Left pixels (M, 2), true right pixels and covariances (M, 2, 2) of a rendered pair's still matches."""
    terrain = Terrain(RIG, 1)
    pairs = [photographed(terrain, moment) for moment in (2, 1)][::-1]
    found: list[MatchedPair] = [match_scene(exact(1.0), pair) for pair in pairs]
    scene = scene_of(exact(1.0), pairs, found)
    own = slice(0, scene.counts[0].used)
    left = scene.features.pixels[own, 0]
    truth, _ = terrain.true_right(left, 1)
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
    each = 0.5 * covariance[:, None].expand(-1, 2, 2, 2)
    return matches_of(torch.stack([left, right], 1), covariance=each)


def rig_data(cameras: tuple[Camera, Camera], features: Features, draw: torch.Generator) -> RigData:
    length = float(RIG.baseline) + TAPE * float(torch.randn((), generator=draw))
    tape = Baseline(first=0, second=1, length=length, sigma=TAPE)
    return RigData(cameras=cameras, names=NAMES, features=features, baselines=(tape,))


T = TypeVar("T")


def kept(file: Path, make: Callable[[], T]) -> T:
    """What a file holds, or what is made and then kept there."""
    if not file.exists():
        made = make()
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(pickle.dumps(made))
    found: T = pickle.loads(file.read_bytes())
    return found


def all_matches(scale: float, count: int, times: str, seed: int, folder: Path) -> tuple[MatchedPair, list[MatchedPair]]:
    """Matches of the first pair, and those of all pairs that stand still in the others; pictures are kept as well."""
    terrain = Terrain(rig_of(scale), seed)

    def matched(moment: int, hour: float) -> tuple[ImagePair, MatchedPair]:
        pair = photographed(terrain, moment, Weather(hour=hour))
        return pair, match_scene(exact(scale), pair)

    found = []
    for moment, hour in enumerate([12.0] * count if times == "minute" else np.linspace(8.0, 17.0, count).tolist()):
        # Pairs that are refused are left out, as `kcal rig` does.
        with contextlib.suppress(InputError):
            file = folder / f"{scale}-{seed}-{moment}-{hour:.2f}.pickle"
            found.append(kept(file, functools.partial(matched, moment, hour)))
    pairs, matches = map(list, zip(*found, strict=True))
    return matches[0], still_matches(pairs, matches)


def noise_bound(rig: TrueRig, cameras: tuple[Camera, Camera], found: list[MatchedPair]) -> float:
    """Cramér-Rao bound of yaw in degrees from matches with unknown ranges whose errors are noise alone, independent."""
    true = Rig.pair(*cameras, rig.right_from_left_rotation, rig.right_from_left_translation)
    total = torch.zeros(5, 5, dtype=torch.float64)
    for one in found:
        lines = line_errors(true, one.pixels)
        slope = lines.slopes / lines.sigma(one.covariance)[:, None]
        total += slope.T @ slope
    return math.degrees(float(torch.linalg.inv(total)[1, 1].sqrt()))


@torch.no_grad()
def yaw_of(scale: float, count: int, times: str, seed: int, folder: Path) -> Record:
    """Yaw from rendered pairs of one terrain with exact lenses: error and σ in degrees, χ² of the relative rotation."""
    rig, cameras = rig_of(scale), exact(scale)
    tape = Baseline(first=0, second=1, length=float(rig.baseline), sigma=TAPE)
    file = folder / f"{scale}-{100 + seed}-{count}-{times}.pickle"
    first, still = kept(file, lambda: all_matches(scale, count, times, 100 + seed, folder))
    record: Record = {}
    for some in {1, 3, count} if times == "minute" else {count}:
        found = [first] if some == 1 else still[:some]
        features = counted(found, rig.left.size).features
        data = RigData(cameras=cameras, names=NAMES, features=features, baselines=(tape,))
        result = solve_rig(data, RigOptions(intrinsics="fixed"))
        turn = vector_from_rotation(result.rotation[1] @ result.rotation[0].T @ rig.right_from_left_rotation.T)
        covariance = result.relative_covariance(0, 1)[:3, :3]
        record[f"{some} of a {times}"] = {
            "error": math.degrees(float(turn[1])), "sigma": math.degrees(float(covariance[1, 1].sqrt())),
            "chi2": float(turn @ torch.linalg.solve(covariance, turn)), "matches": len(features.names),
            "bound": noise_bound(rig, cameras, found),
        }  # fmt: skip
    return record


def yaw_rows(records: list[Record]) -> Iterator[list[str]]:
    """Rows of the table, of all records."""
    found = {(one["key"][0], name) for one in records for name in one if name != "key"}
    for scale, name in sorted(found, key=lambda each: (each[0], each[1][-3:] == "day", int(each[1].split()[0]))):
        # A terrain may be in runs of few and of many pairs.
        own = [*{one["key"][3]: one[name] for one in records if one["key"][0] == scale and name in one}.values()]
        error, sigma, chi2, count, bound = (
            np.array([one[part] for one in own]) for part in ("error", "sigma", "chi2", "matches", "bound")
        )
        z = error / sigma
        yield [
            f"{1920 * scale:.0f} x {1080 * scale:.0f}", name, f"{count.mean():.0f}", f"{len(own)}",
            f"{bound.mean():.5f}°", f"{sigma.mean():.5f}°", f"{np.sqrt(np.square(error).mean()):.5f}°",
            f"{np.sqrt(np.square(z).mean()):.2f}", f"{100 * (np.abs(z) < 1.96).mean():.0f} %", f"{chi2.mean():.1f}",
        ]  # fmt: skip


BLOCK = 120.0  # px


@section("scene.md", "common", moments=1)
@torch.no_grad()
def common(moments: int = 6) -> Lines:
    """Whether means of errors over parts of the image are as large as stated, with and without what matches share.

    The scene stands still, and pairs differ by noise alone and by vehicles. Each part's weighted mean of
    distances from epipolar lines is compared with its standard deviation.
    """
    terrain = Terrain(rig_of(HALF), 2)
    pairs = [photographed(terrain, moment) for moment in range(moments)]
    found = [match_scene(exact(HALF), pair) for pair in pairs]
    yield ["pairs", "parts of the image", "as independent: RMS over σ", "inside 95 %", "RMS over σ", "inside 95 %"]
    for count in [number for number in (1, 3, 6) if number <= moments]:
        z: tuple[list[float], list[float]] = [], []
        for first in range(0, moments + 1 - count, count):
            some = found[first : first + count]
            parts = [[getattr(one, part) for one in some] for part in ("pixels", "covariance", "share")]
            lines = [line_errors(one.rig, one.pixels) for one in some]
            pixels, stated = torch.cat(parts[0]), torch.cat(parts[1])
            rig, _ = posed(found[0].rig, pixels, stated)
            place = (pixels[:, 0] / BLOCK).long()
            block = 100 * place[:, 1] + place[:, 0]
            together = line_errors(rig, pixels)
            error, good = together.off, together.off.abs() < 5.0 * together.sigma(stated)
            for own, covariance in zip(z, (stated, torch.cat(with_common_errors(lines, *parts))), strict=True):
                sigma = together.sigma(covariance)
                for which in block.unique():
                    here = (block == which) & good
                    if int(here.sum()) >= 4 * count:
                        weight = sigma[here] ** -2
                        own.append(float((weight * error[here]).sum() / weight.sum().sqrt()))
        cells = [f"{count}", f"{len(z[0])}"]
        for values in map(np.array, z):
            cells += [f"{np.sqrt(np.square(values).mean()):.2f}", f"{100 * (np.abs(values) < 1.96).mean():.0f} %"]
        yield cells


def landmarks(draw: torch.Generator) -> Landmarks:
    """Twelve surveyed landmarks 100 m to 2.6 km away, in the left camera's frame turned to east, north, up."""
    count = 12
    share = torch.rand(20 * count, 3, dtype=torch.float64, generator=draw)
    distance = 100.0 * 26.0 ** share[:, :1]
    ray = torch.stack([1.0 * (share[:, 1] - 0.5), 0.4 * (share[:, 2] - 0.5), torch.ones_like(share[:, 0])], -1)
    points = distance * ray / ray.norm(dim=-1, keepdim=True)
    pixels, valid = RIG(points)
    left, right = pixels.unbind(-2)
    seen = (valid.all(-1) & RIG.left.inside(left) & RIG.right.inside(right)).nonzero()[:count, 0]
    enu = points[seen] @ torch.tensor([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]], dtype=torch.float64)
    return with_noise(landmarks_of(enu, pixels[seen], 0.02, MARK), draw)


def at_five_km(found: RigResult, draw: torch.Generator) -> tuple[Tensor, Tensor]:
    """Relative errors (T,) of ranges at 5 km of marked targets, and their σ."""
    angle = torch.linspace(-0.4, 0.4, 9, dtype=torch.float64)
    ray = torch.stack([angle.sin(), 0.02 * torch.arange(9) - 0.08, angle.cos()], -1)
    ray = 5000.0 * ray / ray.norm(dim=-1, keepdim=True)
    left, right = RIG(ray)[0].unbind(-2)
    noise = MARK * torch.randn(2, 9, 2, dtype=torch.float64, generator=draw)
    where = Localizer(found.stereo().placed(origin=ORIGIN, heading_deg=0.0), pixel_sigma=MARK)(
        left + noise[0], right + noise[1]
    )
    return 5000.0 * where.inverse_range - 1.0, 5000.0 * where.inverse_range_sigma


@torch.no_grad()
def ranges_of(corner: float, seed: int) -> Record:
    """Relative errors at 5 km and their σ with calibrated lenses: from landmarks, from the scene, from both."""
    straight = RigOptions(refraction=0.0, refraction_sigma=0.0)
    draw = torch.Generator().manual_seed(1000 + seed)
    cameras = tuple(
        calibrate_camera(capture(lens, 30, corner, 2 * seed + k)).camera for k, lens in enumerate((RIG.left, RIG.right))
    )
    scene = rig_data((cameras[0], cameras[1]), drawn(measured(), 1, draw), draw)
    survey = landmarks(draw)
    alone = RigData(cameras=scene.cameras, names=NAMES, landmarks=survey)
    both = dataclasses.replace(scene, landmarks=survey)
    record: Record = {}
    for name, data in (("12 landmarks", alone), ("one pair and a tape", scene), ("both", both)):
        error, sigma = at_five_km(solve_rig(data, straight), draw)
        record[name] = {"error": error.tolist(), "sigma": sigma.tolist()}
    return record


def range_rows(records: list[Record]) -> Iterator[list[str]]:
    """Rows of the table."""
    for corner in sorted({record["key"][0] for record in records}):
        own = [record for record in records if record["key"][0] == corner]
        for name in ("12 landmarks", "one pair and a tape", "both"):
            error, sigma = (np.array([record[name][part] for record in own]) for part in ("error", "sigma"))
            inside = (np.abs(error / sigma) < 1.96).mean(1)
            yield [
                f"{corner}", name, f"{len(own)}", f"{100 * np.sqrt(np.square(error).mean()):.1f} %",
                f"{100 * sigma.mean():.1f} %", f"{np.sqrt(np.square(error / sigma).mean()):.2f}",
                share(inside.tolist(), " %"),
            ]  # fmt: skip


@section("scene.md", "speed", counts=(200,))
@torch.no_grad()
def speed(counts: tuple[int, ...] = (2000, 20_000)) -> Iterator[str]:
    """CPU seconds of the adjustment with calibrated lenses."""
    spent = list[float]()
    cameras = tuple(calibrate_camera(capture(lens, 20, 0.05, k)).camera for k, lens in enumerate((RIG.left, RIG.right)))
    for count in counts:
        draw = torch.Generator().manual_seed(1)
        share = torch.rand(6 * count, 3, dtype=torch.float64, generator=draw)
        rays, _ = RIG.left.unproject(share[:, 1:] * (torch.tensor(RIG.left.size) - 1.0))
        points = 50.0 * 400.0 ** share[:, :1] * rays
        pixels, valid = RIG(points)
        (left, right), valid = pixels.unbind(-2), valid.all(-1)
        seen = (valid & RIG.left.inside(left) & RIG.right.inside(right)).nonzero()[:count, 0]
        places = left[seen], right[seen], torch.full((len(seen), 1, 1), 0.02).double() * torch.eye(2).double()
        data = rig_data((cameras[0], cameras[1]), drawn(places, 1, draw, 0.03), draw)
        spent.append(timed(solve_rig, data)[1])
    rows = [(f"{n:,}", f"{s:.1f}", f"{s / spent[0]:.1f}") for n, s in zip(counts, spent, strict=True)]
    return table(("matches", "CPU s", "times the first"), rows)


@section("scene.md", "picture")
def picture(write: bool = False) -> None:
    """Matches of a pair on the left image, by their range: docs/howto/scene.png."""
    if not write:
        return
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    terrain = Terrain(RIG, 1)
    pairs = [photographed(terrain, moment) for moment in (2, 1)][::-1]
    scene = scene_of(exact(1.0), pairs, [match_scene(exact(1.0), pair) for pair in pairs])
    left = scene.features.pixels[: scene.counts[0].used, 0]
    _, distance = terrain.true_right(left, 1)
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


@section("scene.md", "yaw", seeds=range(1), scale=0.25, pairs=1, times=("minute",))
def yaw(
    kept: Kept = NOT_KEPT, seeds: range = range(30), scale: float = 0.5, pairs: int = 10,
    times: tuple[str, ...] = ("minute", "day"), folder: Path = Path("build/scene"),
) -> Iterator[str]:  # fmt: skip
    """Of so many pairs of a minute and of a day; pictures and their matches stay in a folder."""
    keys = [(scale, pairs, when, seed) for seed in seeds for when in times]
    heads = ["pictures, px", "pairs", "matches", "terrains", "bound of noise", "σ of yaw", "RMS error", "over σ"]
    records = kept.records(keys, functools.partial(yaw_of, folder=folder), _brief)
    return table([*heads, "inside 95 %", "pose χ² of 3"], yaw_rows(records))


@section("scene.md", "ranges", seeds=range(1), corners=(0.05,))
def ranges(kept: Kept = NOT_KEPT, seeds: range = range(30), corners: tuple[float, ...] = (0.05, 0.2)) -> Iterator[str]:
    records = kept.records([(corner, seed) for seed in seeds for corner in corners], ranges_of, _brief)
    heads = ["corners, px", "from", "rigs", "RMS error at 5 km", "mean σ", "over σ", "inside 95 %"]
    return table(heads, range_rows(records))


def _brief(record: Record) -> str:
    return " ".join(f"{name} {np.mean(value['sigma']):.2g}" for name, value in record.items() if name != "key")


KINDS = ("level ground", "hills and walls", "edges before something farther")
BESIDE = 0.08  # px, added to the σ of each match in weights
PATCH, DEEP = 21, 0.03  # px, and the logarithm of the depth's ratio in a patch from which there is an edge


class Errors(NamedTuple):
    """Matches (M,): kind, px across their lines with noise and without, σ, and degrees of yaw by those without."""

    kind: Tensor
    noisy: Tensor
    clean: Tensor
    sigma: Tensor
    yaw: Tensor


def kinds(terrain: Terrain, pixels: Tensor) -> Tensor:
    """Kind (M,) of patches around pixels (M, 2) of the left image; -1: something moves there."""
    picture = terrain.picture(0, 1, Weather())
    depth = np.minimum(picture.depth, 1e6)
    level = minimum_filter(picture.ground.astype(np.uint8), PATCH) > 0
    deep = np.log(maximum_filter(depth, PATCH) / minimum_filter(depth, PATCH)) > DEEP
    kind = np.where(level, 0, np.where(deep, 2, 1))
    kind[maximum_filter(picture.moving, PATCH)] = -1
    at = pixels.round().long()
    return torch.from_numpy(kind)[at[:, 1], at[:, 0]]


@torch.no_grad()
def errors_of(seed: int) -> Errors:
    """Of a terrain."""
    rig, cameras = rig_of(HALF), exact(HALF)
    true = Rig.pair(*cameras, rig.right_from_left_rotation, rig.right_from_left_translation)
    terrain, weather = Terrain(rig, seed), Weather()
    images = terrain.images(1, weather)
    light = [gaussian_filter(terrain.picture(side, 1, weather).light, weather.blur) for side in (0, 1)]
    points = keypoints(images[0], 8000), keypoints(images[1], 8000)
    index = guided_matches(true, points)
    left, right = (own.pixels[index[:, k]] for k, own in enumerate(points))
    noisy, clean = (
        refine_matches(true, (one, two), left, right)
        for one, two in [[torch.from_numpy(part.astype(np.float32)) for part in each] for each in (images, light)]
    )
    truth, _ = terrain.true_right(left, 1)
    near = [torch.linalg.vector_norm(found.right - truth, dim=-1) < WRONG for found in (noisy, clean)]
    kind = kinds(terrain, left)
    good = noisy.good & clean.good & near[0] & near[1] & (kind >= 0)
    lines = [line_errors(true, torch.stack([left, found.right], 1)[good]) for found in (noisy, clean)]
    sigma = lines[0].sigma(noisy.covariance[good])
    weight = 1.0 / (sigma.square() + BESIDE**2) * (lines[1].off.abs() < 5.0 * BESIDE)
    slopes = lines[1].slopes
    variance = torch.linalg.inv(slopes.T @ (weight[:, None] * slopes))
    yaw = (slopes @ variance[1]) * weight * lines[1].off
    return Errors(kind[good], lines[0].off, lines[1].off, sigma, yaw.rad2deg())


def rows(found: list[Errors]) -> Iterator[list[str]]:
    """Rows of the table."""
    every = Errors(*(torch.cat(parts) for parts in zip(*found, strict=True)))
    for number, name in enumerate((*KINDS, "all")):
        own = (every.kind == number) | (number == len(KINDS))
        turns = [float(one.yaw[(one.kind == number) | (number == len(KINDS))].sum()) for one in found]
        error = torch.tensor(turns)
        yield [
            name, f"{int(own.sum()) / len(found):.0f}", f"{rms(every.noisy[own]):.3f}", f"{rms(every.sigma[own]):.3f}",
            f"{rms(every.clean[own]):.3f}", f"{float(every.clean[own].abs().median()):.3f}", f"{rms(error):.5f}°",
            f"{float(error.mean()):+.5f} ± {float(error.std()) / math.sqrt(len(found)):.5f}°",
        ]  # fmt: skip


HEADS = ("what", "matches", "RMS, px", "σ of noise", "of it repeats, RMS", "median", "yaw, RMS", "yaw, mean")


@section("scene.md", "repeats", seeds=range(700, 701))
def repeats(seeds: range = range(700, 712)) -> Iterator[str]:
    return table(HEADS, rows([errors_of(seed) for seed in seeds]))
