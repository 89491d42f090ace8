"""What errs in a real scene at long range: relative yaw by noise, by halves of matches, by lenses, and by causes.

Of KCAL_DATA/longrange. Cameras that are calibrated already are kept in build/long-range.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from kcal import CalibrationOptions, Camera, Features, Observations, Rig, RigOptions, calibrate_camera, solve_rig
from kcal.calibrate.rig.result import RigResult
from kcal.calibrate.rig.sources import Baseline, RigData
from kcal.files import make_folder
from kcal.io.camera_file import load_camera, save_camera
from kcal.lens import rotation_from_vector, vector_from_rotation
from kcal.lens.pose import side_axes
from kcal.locate.stereo import sight_lines
from kcal.rig import read_features
from kcal.scene.common_errors import line_errors
from scripts.shared.page import Lines, section, table
from scripts.shared.real_captures import data_folder

PICTURE = Path(__file__).parents[2] / "docs" / "measured" / "long-range.png"
TRIALS = Path("build/long-range")
LENGTH, TAPE = 2.1336, 0.01
HALVES = ["halves", "pitch", "yaw", "roll", "χ² of 5"]
DEGREE = 180.0 / math.pi
# Pixels in the middle of the upper half of the image: where far things are, and no match.
FAR = torch.cartesian_prod(torch.linspace(1500.0, 4500.0, 7), torch.linspace(900.0, 1900.0, 3)).double()
# Of the principal point, and a unit of the polynomials.
MIDDLE, UNIT = torch.tensor([2998.0, 2006.5], dtype=torch.float64), 2000.0
Field = Callable[[Tensor], Tensor]


def lens(observations: Observations, name: str, model: str | None = None) -> Camera:
    """The camera of some views, calibrated once."""
    path, count = make_folder(TRIALS) / f"{name.replace(' ', '-')}.camera.json", len(observations.views)
    if not path.exists():
        views = {"first half": slice(count // 2), "second half": slice(count // 2, count)}.get(name, slice(count))
        some = observations.model_copy(update={"views": observations.views[views]})
        options = CalibrationOptions() if model is None else CalibrationOptions(model=model)
        save_camera(calibrate_camera(some, options).camera, path)
    return load_camera(path)


def solved(features: Features, camera: Camera, sigma: float, change: float = 0.0) -> RigResult:
    """By kcal, with so many pixels of noise stated, and of change of the lens since its calibration."""
    tape = Baseline(first=0, second=1, length=LENGTH, sigma=TAPE)
    some = dataclasses.replace(features, pixel_sigma=sigma)
    data = RigData(cameras=(camera,) * 2, names=("left", "right"), features=some, baselines=(tape,))
    return solve_rig(data, RigOptions(lens_change=change))


def turned(rotation: Tensor, reference: Tensor) -> list[float]:
    """Degrees of pitch, yaw and roll of the right camera against a reference."""
    return (DEGREE * vector_from_rotation(rotation @ reference.T)).tolist()


@dataclasses.dataclass
class Fit:
    """A pose from how far matches lie off their epipolar lines, and what else changes that.

    Args:
        step: (5 + K,) of turns (rad), shifts across the baseline, and K amounts.
        covariance: of it, with the noise that is left.
        off: (M,) px, what is left.
    """

    step: Tensor
    covariance: Tensor
    off: Tensor

    @property
    def sigma(self) -> float:
        """Pixels of noise that are left."""
        return math.sqrt(float(self.off.square().sum()) / (len(self.off) - len(self.step)))


def fitted(rig: Rig, pixels: Tensor, more: Tensor | None = None) -> Fit:
    """Least squares of one step from a rig, with columns (M, K) of what else may be wrong."""
    found = line_errors(rig, pixels)
    columns = found.slopes if more is None else torch.cat([found.slopes, more], 1)
    scale = columns.norm(dim=0)
    inverse = torch.linalg.pinv(columns / scale) / scale[:, None]
    step = -inverse @ found.off
    left = found.off + columns @ step
    variance = float(left.square().sum()) / (len(left) - len(step))
    return Fit(step, variance * inverse @ inverse.T, left)


def stepped(rig: Rig, step: Tensor) -> Rig:
    """A rig after the five steps of `line_errors`."""
    turn, shift = rotation_from_vector(step[:3]), rig.right_from_left_translation
    across = torch.cat(side_axes(shift[None] / rig.baseline))
    moved = shift + rig.baseline * step[3:5] @ across
    return Rig.pair(rig.left, rig.right, turn @ rig.right_from_left_rotation, moved * rig.baseline / moved.norm())


def refitted(rig: Rig, pixels: Tensor) -> Rig:
    """A rig whose pose fits matches best."""
    for _ in range(6):
        rig = stepped(rig, fitted(rig, pixels).step)
    return rig


def centered(pixels: Tensor) -> Tensor:
    return (pixels - MIDDLE) / UNIT


def radial(power: int) -> Field:
    return lambda p: centered(p) * centered(p).square().sum(-1, keepdim=True) ** power


def along(axis: int) -> Field:
    return lambda p: torch.eye(2, dtype=p.dtype)[axis].expand_as(p)


def nothing(pixels: Tensor) -> Tensor:
    return torch.zeros_like(pixels)


def column(rig: Rig, pixels: Tensor, left: Tensor, right: Tensor) -> Tensor:
    """(M,) px by which matches come off their lines where pixels are shown elsewhere, by (M, 2) each."""
    shift = torch.stack([left, right], 1)
    more, less = (line_errors(rig, pixels + sign * 0.1 * shift).off for sign in (1.0, -1.0))
    return (more - less) / 0.2


def far_shift(rig: Rig, step: Tensor, left: Field, right: Field) -> float:
    """Pixels of disparity that a step of the pose and fields of both images add to what is at infinity."""
    rays, valid = rig.left.unproject(FAR)
    before = rig.right.project(rays @ rig.right_from_left_rotation.T)[0]
    turn = rotation_from_vector(step[:3]) @ rig.right_from_left_rotation
    after = rig.right.project(rays @ turn.T)[0]
    own = left(FAR) - right(before)
    return float(((after - before)[:, 0] + own[:, 0])[valid].mean())


def causes(rig: Rig, pixels: Tensor) -> Lines:
    """Rows: each cause alone beside the pose, with what matches say of it, and what one unit of it does."""
    points = sight_lines(rig, pixels[:, 0], pixels[:, 1]).points
    both = points, rig.right_from_left(points)
    pupil = []
    for camera, own in zip((rig.left, rig.right), both, strict=True):
        moved = own.clone()
        moved[:, 2] += 1e-3 * torch.atan2(own[:, :2].norm(dim=-1), own[:, 2]).square()
        pupil.append(camera.project(moved)[0] - camera.project(own)[0])
    place = centered(pixels[:, 0])
    ranges = points.norm(dim=-1)
    plain = fitted(rig, pixels)

    def field(own: Field, *, right: bool) -> tuple[Tensor, Field, Field]:
        left = nothing if right else own
        return column(rig, pixels, left(pixels[:, 0]), own(pixels[:, 1])), left, own

    tried = {
        "focal length, scene against board": (field(radial(0), right=False), "px at 2000 px"),
        "principal point across, scene against board": (field(along(0), right=False), "px"),
        "principal point down, scene against board": (field(along(1), right=False), "px"),
        "radial, r³": (field(radial(1), right=False), "px at 2000 px"),
        "radial, r⁵": (field(radial(2), right=False), "px at 2000 px"),
        "focal length, one place against the other": (field(radial(0), right=True), "px at 2000 px"),
        "principal point across, one place against the other": (field(along(0), right=True), "px"),
        "principal point down, one place against the other": (field(along(1), right=True), "px"),
        "entrance pupil": ((column(rig, pixels, *pupil), nothing, nothing), "mm per rad²"),
        "matches, the same shift everywhere": ((torch.ones(len(pixels)).double(), nothing, nothing), "px"),
        "matches, by columns": ((place[:, 0], nothing, nothing), "px at 2000 px"),
        "matches, by rows": ((place[:, 1], nothing, nothing), "px at 2000 px"),
        "matches, by inverse range": ((10.0 / ranges, nothing, nothing), "px at 10 m"),
    }
    for name, ((one, left, right), unit) in tried.items():
        fit = fitted(rig, pixels, one[:, None])
        response = fitted_response(rig, pixels, one)
        amount, sigma = float(fit.step[5]), float(fit.covariance[5, 5].sqrt())
        # A pose that matches were fitted to makes up for an error of one unit that nobody knows of.
        yaw, far = DEGREE * float(response[1]), far_shift(rig, response, left, right)
        yield [
            name, f"{amount:+.2f} ± {sigma:.2f} {unit}", f"{amount / sigma:+.1f}",
            f"{DEGREE * float((fit.step - torch.nn.functional.pad(plain.step, (0, 1)))[1]):+.4f} ± "
            f"{DEGREE * float(fit.covariance[1, 1].sqrt()):.4f}°",
            f"{yaw:+.4f}°", f"{far:+.2f}",
        ]  # fmt: skip


def fitted_response(rig: Rig, pixels: Tensor, one: Tensor) -> Tensor:
    """(5,) the step of the pose that a shift of matches (M,) off their lines makes."""
    slopes = line_errors(rig, pixels).slopes
    return -torch.linalg.lstsq(slopes, one[:, None]).solution[:, 0]


def halves(rig: Rig, pixels: Tensor) -> Lines:
    """Rows: differences of pitch, yaw and roll between halves of the matches, and their χ²."""
    ranges = sight_lines(rig, pixels[:, 0], pixels[:, 1]).points.norm(dim=-1)
    by = {"left, right": pixels[:, 0, 0], "high, low": pixels[:, 0, 1], "near, far": ranges}
    for name, value in by.items():
        one = value < value.median()
        a, b = fitted(rig, pixels[one]), fitted(rig, pixels[~one])
        difference, covariance = a.step - b.step, a.covariance + b.covariance
        chi2 = float(difference @ torch.linalg.solve(covariance, difference))
        cells = [f"{DEGREE * v:+.3f} ± {DEGREE * s:.3f}°" for v, s in
                 zip(difference[:3].tolist(), covariance.diagonal()[:3].sqrt().tolist(), strict=True)]  # fmt: skip
        yield [name, *cells, f"{chi2:.1f}"]


def picture(rig: Rig, pixels: Tensor, out: Tensor) -> None:
    """How far matches lie off their lines, over the image, and by range."""
    from matplotlib import pyplot as plt

    off = line_errors(rig, pixels).off
    ranges = sight_lines(rig, pixels[:, 0], pixels[:, 1]).points.norm(dim=-1)
    figure, (image, far) = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained", width_ratios=(1.5, 1))
    shown = image.scatter(*pixels[:, 0].T, c=off.clamp(-1, 1), cmap="coolwarm", s=22, edgecolors="0.4", linewidths=0.3)
    image.scatter(*pixels[out, 0].T, s=90, facecolors="none", edgecolors="black", label="left out")
    image.set(xlim=(0, 6016), ylim=(4016, 0), xlabel="column, px", ylabel="row, px", aspect="equal")
    image.set_title("matches in the left image")
    image.legend(loc="upper left")
    figure.colorbar(shown, ax=image, label="off the epipolar line, px (clipped at 1)")
    far.axhline(0.0, color="0.6", linewidth=0.8)
    far.scatter(ranges, off, s=12, color="tab:blue")
    far.scatter(ranges[out], off[out], s=60, facecolors="none", edgecolors="black")
    far.set(xscale="log", xlabel="range, m", ylabel="off the line, px", xticks=[10, 20, 40], xticklabels=[10, 20, 40])
    far.minorticks_off()
    figure.savefig(PICTURE, dpi=110)


@functools.cache
def scene() -> tuple[Observations, Features, dict[float, RigResult]]:
    """Views of the board, matches, and rigs by the noise that is stated of these."""
    folder = data_folder() / "longrange"
    observations = Observations.load(folder / "board.obs.json")
    features = read_features(folder / "features.csv", 0.3)
    camera = lens(observations, "all views")
    return observations, features, {sigma: solved(features, camera, sigma) for sigma in (0.3, 0.2, 0.15)}


def kept_matches() -> tuple[Rig, Tensor, Tensor]:
    """The rig of the smallest noise, all matches, and which it leaves out."""
    _, features, results = scene()
    names = {item.name for item in results[0.15].left_out}
    return results[0.15].stereo(), features.pixels, torch.tensor([name in names for name in features.names])


@section("long-range.md", "noise")
def noise() -> Lines:
    yield ["stated noise", "left out", "χ² / freedom", "pitch", "yaw", "roll"]
    _, _, results = scene()
    for sigma, found in results.items():
        turn = turned(found.stereo().right_from_left_rotation, results[0.3].stereo().right_from_left_rotation)
        sigmas = (DEGREE * found.sigma_rotation).tolist()
        cells = [f"{value:+z.4f} ± {own:.4f}°" for value, own in zip(turn, sigmas, strict=True)]
        left_out = ", ".join(item.name for item in found.left_out)
        yield [f"{sigma} px", left_out, f"{found.chi2 / found.freedom:.2f}", *cells]


@section("long-range.md", "halves-all")
def halves_of_all() -> Lines:
    rig, every, _ = kept_matches()
    return table(HALVES, halves(rig, every))


@section("long-range.md", "halves")
def halves_of_kept() -> Lines:
    rig, every, out = kept_matches()
    return table(HALVES, halves(rig, every[~out]))


@section("long-range.md", "lenses", lenses=("all views",))
def lenses(lenses: tuple[str, ...] = ("all views", "first half", "second half", "opencv8")) -> Lines:
    rig, every, out = kept_matches()
    yield ["lens from", "RMS of corners, px", "matches off, px", "pitch", "yaw", "roll"]
    base = refitted(rig, every[~out])
    for name in lenses:
        other = lens(scene()[0], name, "opencv8" if name == "opencv8" else None)
        pose = rig.right_from_left_rotation, rig.right_from_left_translation
        own = refitted(Rig.pair(other, other, *pose), every[~out])
        turn = turned(own.right_from_left_rotation, base.right_from_left_rotation)
        record = other.calibration.record if other.calibration else None
        rms = "" if record is None else f"{record.rms:.2f}"
        yield [name, rms, f"{fitted(own, every[~out]).sigma:.3f}", *(f"{value:+z.4f}°" for value in turn)]


@section("long-range.md", "change")
def changes(sizes: tuple[float, ...] = (0.0, 1.0, 3.0, 10.0)) -> Lines:
    _, features, results = scene()
    yield ["change of the lens, at the corner", "of the distance from the middle", "yaw"]
    first = results[0.15].stereo()
    for size in sizes:
        found = solved(features, lens(scene()[0], "all views"), 0.15, size)
        yaw = turned(found.stereo().right_from_left_rotation, first.right_from_left_rotation)[1]
        share = 100.0 * size / (0.5 * math.hypot(*first.left.size))
        yield [f"{size:g} px", f"{share:.3f} %", f"{yaw:+z.4f} ± {DEGREE * float(found.sigma_rotation[1]):.4f}°"]


@section("long-range.md", "causes")
def all_causes(write: bool = False) -> Lines:
    rig, every, out = kept_matches()
    base = refitted(rig, every[~out])
    if write:
        picture(base, every, out)
    heads = ["cause", "as matches say", "in its σ", "changes yaw by", "one unit, unknown, changes yaw by"]
    return table([*heads, "and disparity at infinity by, px"], causes(base, every[~out]))
