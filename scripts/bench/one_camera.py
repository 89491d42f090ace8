"""The hybrid camera, fitted by evidence, on real captures: views that were held out, beside parametric models.

The wide lens in blocks or every other view, or all but 8 of its views in three draws; OpenCV's images with one view
left out, and their pairs, 9 fitted and 4 held out. mrcal and lensboy, of the wide lens, where KCAL_MRCAL and
KCAL_LENSBOY name interpreters that have them; elsewhere their cells stay as the page has them.

On each held-out view only its pose is solved again; camera and board stay as fitted. Measure: sqrt(sum w² |r|² / count)
over all folds, with the weights of the file (OpenCV's images: all one). Epipolar error:
Sampson's distance of held-out corners in pixels, which needs no board. *fields*: kinds of fields of the hybrid lens.

Boards whose corners are off their places one by one: found, true, and what they do to the camera.

Simulated: the traced lenses of `scripts.shared.simulated`, on a stand. Boards are exact, printed
(`PrintedBoard`), or printed with each corner off by 0.03 mm in x and y (standard deviation). *Smooth*: without the
term for single corners. Real: a camera is fitted to either half of its views with a board of smooth errors alone
(*smooth*), with single corners of its own (*default*), and with the corners that the **other** camera found in its own
views, held (*other's*). The other half is then predicted: poses are refitted, board and camera are held.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import statistics
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kcal import CalibrationOptions, Camera, Observations, Rig, RigOptions, calibrate_camera, calibrate_rig
from kcal.calibrate.hybrid.fit import FitOptions, HybridFit, fit_hybrid
from kcal.calibrate.hybrid.fitted_views import moving_residuals
from kcal.lens.field_modes import GaussianModes, NetworkModes
from kcal.lens.zernike import ZernikeModes
from kcal.nets import FieldTraining
from kcal.sim.captures import BoardLike, BoardSize, PrintedBoard
from scripts.shared.children import interpreter
from scripts.shared.page import NOT_KEPT, Kept, Lines, Record, merged, rms, section, share, timed
from scripts.shared.peer_lenses import splined
from scripts.shared.real_captures import load, over_parts, parts_of, stereo_images, warped
from scripts.shared.simulated import BOARD, against_truth, simulated

# The spline of mrcal that predicts held-out views of the wide lens best, and about its focal length, pixels.
SPLINE, FOCAL = "SPLINED11x8", 1900.0
# Other programs' lenses, by program.
PEERS = {
    f"{peer}, {lens}": (peer, lens) for peer, lens in (("mrcal", SPLINE), ("lensboy", "OPENCV14"), ("lensboy", SPLINE))
}
SPLITS = {"blocks20": "whole blocks of views", "evenodd": "every other view"}
# A camera and the corners of its board (N, 3), from views and their weights (V, N).
Fitter = Callable[[Observations, Tensor], tuple[Camera, Tensor]]


def by_evidence(seen: Observations, weight: Tensor, options: FitOptions | None = None) -> tuple[Camera, Tensor]:
    found = fit_hybrid(seen.board.points, seen.pixels(), seen.image_size, weight, options)
    told = f"sigma {found.sigma:.3f} px, tempering {found.tempering:.2f}"
    print(f"    {told}, {found.effective:.1f} effective parameters", flush=True)
    return found.camera, found.board_points


def parametric(model: str, weak_prior: float | None, seen: Observations, weight: Tensor) -> tuple[Camera, Tensor]:
    found = calibrate_camera(seen, CalibrationOptions(model=model, board_warp=True, weak_prior=weak_prior))
    assert found.board_warp is not None
    return found.camera, warped(seen, found.board_warp)


MODELS: dict[str, Fitter] = {
    "hybrid": by_evidence,
    "opencv5": functools.partial(parametric, "opencv5", None),
    "opencv14, weak prior": functools.partial(parametric, "opencv14", 0.3),
    "ext20, weak prior": functools.partial(parametric, "ext20", 0.3),
}


def with_peer(peer: str, lens: str, seen: Observations, weight: Tensor, parts: list[np.ndarray]) -> str:
    """A lens of another program, with a warped board."""
    corners, weights = seen.pixels().numpy(), weight.numpy()
    about: Any = {"size": seen.image_size, "board": seen.board, "focal": FOCAL}
    found = [splined(lens, corners, weights, out, **about, peer=peer) for out in parts]
    total, seconds, count = (sum(one[key] for one in found) for key in ("sum", "cpu_s", "count"))
    return f"{math.sqrt(total / count):.4f} ({seconds / len(parts):.1f} s)"


def measure(name: str, seen: Observations, weight: Tensor, parts: list[np.ndarray]) -> str:
    if name in PEERS:
        return with_peer(*PEERS[name], seen, weight, parts)
    error, seconds = over_parts(MODELS[name], seen, weight, parts)
    return f"{error:.4f} ({seconds:.1f} s)"


def epipolar(rig: Rig, left: Tensor, right: Tensor) -> Tensor:
    """Sampson's distances (N,) in pixels of matched corners (N, 2) from coplanarity."""
    pixels = torch.cat([left, right], -1).requires_grad_(True)
    rays = [camera.unproject(part)[0] for camera, part in zip((rig.left, rig.right), pixels.split(2, -1), strict=True)]
    turned = rays[0] @ rig.right_from_left_rotation.T
    volume = (torch.linalg.cross(turned, rays[1]) * rig.right_from_left_translation).sum(-1)
    (slope,) = torch.autograd.grad(volume.sum(), pixels)
    return (volume / slope.norm(dim=-1)).detach()


def rig_of(model: str, sides: list[Observations]) -> Rig:
    """Both cameras and the rig by default, from the same pairs: lenses, board and pose are refined together."""
    name, _, prior = model.partition(", ")
    options = CalibrationOptions(model=name, weak_prior=0.3 if prior else None) if name != "hybrid" else None
    cameras = [calibrate_camera(seen, options).camera for seen in sides]
    pairs = list(zip(sides[0].names, sides[1].names, strict=True))
    return calibrate_rig(cameras[0], cameras[1], sides[0], sides[1], pairs, RigOptions(reject=False)).stereo()


def measure_epipolar(name: str, sides: list[Observations]) -> float:
    """RMS over all rotations of 9 pairs fitted and 4 held out."""
    count, errors = len(sides[0].views), []
    for begin in range(count):
        out = [(begin + 3 * i) % count for i in range(4)]
        train = [[seen.names[i] for i in range(count) if i not in out] for seen in sides]
        rig = rig_of(name, [seen.subset(names) for seen, names in zip(sides, train, strict=True)])
        left, right = (seen.pixels()[out].reshape(-1, 2) for seen in sides)
        both = torch.isfinite(left).all(-1) & torch.isfinite(right).all(-1)
        errors.append(epipolar(rig, left[both], right[both]))
    return float(torch.cat(errors).square().mean().sqrt())


def by_views(seen: Observations) -> tuple[Tensor, list[np.ndarray]]:
    """Weights (V, N) that are all alike, and parts of one view each."""
    return torch.isfinite(seen.pixels()).all(-1).double(), [np.array([i]) for i in range(len(seen.views))]


def cases(few: int) -> Iterator[tuple[str, Callable[[str], str], bool]]:
    """What is held out, the cell of a model, and whether other programs can do it."""
    seen, weight = load("wide")
    count = len(seen.views)
    draws = [np.random.default_rng(seed).permutation(count)[few:] for seed in (100, 101, 102)]
    splits = {words: parts_of(split, count) for split, words in SPLITS.items()} | {f"all but {few} views": draws}
    for words, parts in splits.items():
        yield f"wide lens, {words}", functools.partial(measure, seen=seen, weight=weight, parts=parts), True
    sides = [stereo_images(side) for side in ("left", "right")]
    for side, one in zip(("left", "right"), sides, strict=True):
        weight, parts = by_views(one)
        cell = functools.partial(measure, seen=one, weight=weight, parts=parts)
        yield f"OpenCV's images, {side}, each view", cell, False
    yield "OpenCV's pairs, 4 of 13", lambda name: f"{measure_epipolar(name, sides):.4f}", False


@section("one-camera.md", "held-out", models=("opencv5",), only="left, each view")
def held_out_views(models: tuple[str, ...] = tuple(MODELS), views: int = 8, only: str = "") -> Iterator[str]:
    """With so many views of the wide lens fitted in one of its rows; only rows whose name contains this."""
    peers = [name for name, (peer, _) in PEERS.items() if interpreter(peer)]
    rows = []
    for what, cell, able in cases(views):
        if only in what:
            wanted = (*models, *(peers if able else ()))
            rows.append([what, *(cell(name) if name in wanted else None for name in (*MODELS, *PEERS))])
    return merged("one-camera.md", "held-out", ["held out", *MODELS, *PEERS], rows)


TRAINED = 40
# Kinds of fields of the hybrid lens.
KINDS = {
    "zernike": FitOptions(modes=ZernikeModes()),
    "gaussian, 3 widths": FitOptions(modes=GaussianModes()),
    "gaussian, 4 widths": FitOptions(modes=GaussianModes(widths=(1.0, 0.5, 0.25, 0.125))),
    "network, 60 random features": FitOptions(modes=NetworkModes.random(60)),
    f"network, {TRAINED} trained features": FitOptions(modes=NetworkModes.random(TRAINED), training=FieldTraining()),
}


@section("one-camera.md", "fields", wide_folds=1, stereo_folds=1, kinds=("zernike",))
def fields(wide_folds: int = 5, stereo_folds: int = 13, kinds: tuple[str, ...] = tuple(KINDS)) -> Lines:
    seen, weight = load("wide")
    cases = {"wide lens, whole blocks": (seen, weight, parts_of("blocks20", len(weight))[:wide_folds])}
    for side in ("left", "right"):
        weight, parts = by_views(seen := stereo_images(side))
        cases[f"{side}, each view"] = seen, weight, parts[:stereo_folds]
    yield ["field", *cases, "CPU s, wide lens"]
    for kind in kinds:
        found = [over_parts(functools.partial(by_evidence, options=KINDS[kind]), *case) for case in cases.values()]
        yield [kind, *(f"{error:.4f}" for error, _ in found), f"{found[0][1]:.1f}"]


NOISES, OFF, VIEWS = (0.08,), 3e-5, (8, 30)
SIZE = BOARD.columns, BOARD.rows, BOARD.square
PAIRS = (("st1_l", "st1_r"), ("gavin_l", "gavin_r"), ("stereo_left", "stereo_right"))


@dataclass(frozen=True)
class SpeckledBoard(PrintedBoard):
    """A printed board whose corners are off by `OFF` beside the smooth errors."""

    def errors(self, points: Tensor) -> Tensor:
        """Also of each corner by itself."""
        random = torch.randn(points.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(self.seed))
        return super().errors(points) + OFF * random * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)


class _Smooth(CalibrationOptions):
    def of_fit(self, size: tuple[int, int]) -> FitOptions:
        return dataclasses.replace(super().of_fit(size), corners=False)


def board_of(kind: str, seed: int) -> BoardLike:
    """The board of a capture."""
    if kind == "exact":
        return BoardSize(*SIZE)
    return (SpeckledBoard if kind == "corners" else PrintedBoard)(*SIZE, seed)


def simulation(kind: str, noise: float, views: int, seed: int) -> Record:
    """One capture, calibrated with and without the term."""
    case, found = simulated(seed, views, noise, False, board=board_of(kind, seed)), {}
    for name, options in (("default", CalibrationOptions()), ("smooth", _Smooth())):
        found[name], spent = timed(against_truth, case, options)
        found[name] |= {"cpu_s": spent}
    return found


def fitted(seen: Observations, corners: bool, off: Tensor | None = None) -> HybridFit:
    """A camera and its board; with corners that are known to be off by (N, 2) meters."""
    points = seen.board.points
    points = points if off is None else points + torch.nn.functional.pad(off, (0, 1))
    return fit_hybrid(points, seen.pixels(), seen.image_size, options=FitOptions(corners=corners))


def predicted(fit: HybridFit, whole: HybridFit, seen: Observations, views: list[int]) -> float:
    """RMS in pixels of views that were not fitted; their poses begin where those of the whole capture are."""
    assert whole.readout is not None
    still = fit.stillness if fit.readout is not None else whole.stillness
    left = moving_residuals(
        fit.camera, fit.board_points, seen.pixels()[views], whole.state.rotation[views],
        whole.state.translation[views], fit.readout or whole.readout, still,
    )  # fmt: skip
    return float(left.square().sum(-1).nanmean().sqrt())


def real(_: str, name: str, other: str) -> Record:
    """One camera of a pair."""
    seen, theirs = (load(each).seen for each in (name, other))
    whole, own, told = fitted(seen, False), fitted(seen, True), fitted(theirs, True)
    record: Record = {"sigma": [whole.sigma, own.sigma], "rms": {"smooth": whole.rms, "default": own.rms}}
    if own.displaced is None or told.displaced is None:
        return record
    both = torch.stack([own.displaced.flatten(), told.displaced.flatten()])
    record |= {"off_mm": 1e3 * float(own.displaced.square().sum(1).mean().sqrt())}
    record |= {"correlation": float(torch.corrcoef(both)[0, 1])}
    record["rms"]["other's"] = fitted(seen, False, told.displaced).rms
    record["held"] = {"smooth": [], "default": [], "other's": []}
    count = len(seen.views)
    for first in (list(range(count // 2)), list(range(count // 2, count))):
        rest, half = [i for i in range(count) if i not in first], seen.subset([seen.names[i] for i in first])
        fits = fitted(half, False), fitted(half, True), fitted(half, False, told.displaced)
        for kind, fit in zip(record["held"], fits, strict=True):
            record["held"][kind].append(predicted(fit, whole, seen, rest))
    change = own.camera.params.detach() - whole.camera.params.detach()
    sigma = whole.covariance.diagonal().sqrt()
    record["moved"] = float((change[:4] / sigma[:4]).abs().max())
    return record


def simulated_lines(records: list[Record]) -> Lines:
    """A row for each kind of board, number of views and fit."""
    yield [
        "views", "noise, px", "board", "fit", "captures", "found", "in 95 %, whole image", "median error, px",
        "RMS error", "RMS stated", "CPU s",
    ]  # fmt: skip
    cells = dict[tuple[str, float, int], list[Record]]()
    for record in records:
        cells.setdefault(tuple(record["key"][:3]), []).append(record)
    for (kind, noise, views), own in sorted(cells.items(), key=lambda cell: cell[0][::-1]):
        for fit in ("smooth", "default"):
            known = [record[fit] for record in own if "refused" not in record[fit]]
            found = statistics.fmean("corners" in record["terms"] for record in known)
            true, stated = [record["rms"] for record in known], [record["predicted"] for record in known]
            yield [
                views, noise, kind, fit, len(own), f"{100 * found:.0f} %" if fit == "default" else "–",
                share(one["everywhere"] for one in known),
                f"{statistics.median(true):.3f}", f"{rms(true):.3f}", f"{rms(stated):.3f}",
                f"{statistics.fmean(record['cpu_s'] for record in known):.2f}",
            ]  # fmt: skip


def real_lines(records: list[Record]) -> Lines:
    """A row for each camera."""
    yield [
        "camera", "corners are off, mm", "correlation with the other's", "RMS, px: smooth / default / other's",
        "held out: smooth / default / other's", "f, c moved by at most, σ",
    ]  # fmt: skip
    for record in records:
        cells = [f"{record['off_mm']:.3f}", f"{record['correlation']:.2f}"] if "off_mm" in record else ["–", "–"]
        cells += [" / ".join(f"{value:.4f}" for value in record["rms"].values())]
        held = [math.sqrt(statistics.fmean(v * v for v in values)) for values in record.get("held", {}).values()]
        cells += [" / ".join(f"{value:.4f}" for value in held) or "–"]
        yield [record["key"][1], *cells, f"{record['moved']:.1f}" if "moved" in record else "–"]


@section("one-camera.md", "board-corners", seeds=range(1), views=(8,))
def of_simulated(
    kept: Kept = NOT_KEPT, seeds: range = range(100), boards: tuple[str, ...] = ("exact", "corners"),
    views: tuple[int, ...] = VIEWS, noises: tuple[float, ...] = NOISES,
) -> Lines:  # fmt: skip
    keys = [
        (board, noise, count, seed) for seed, board, noise, count in itertools.product(seeds, boards, noises, views)
    ]
    return simulated_lines(kept.records(keys, simulation))


@section("one-camera.md", "board-corners-real", pairs=("stereo_left",))
def of_real(kept: Kept = NOT_KEPT, pairs: tuple[str, ...] = tuple(pair[0] for pair in PAIRS)) -> Lines:
    """The pairs of cameras in KCAL_DATA that begin with these."""
    keys = [("real", *names) for pair in PAIRS if pair[0] in pairs for names in (pair, pair[::-1])]
    return real_lines(kept.records(keys, real))
