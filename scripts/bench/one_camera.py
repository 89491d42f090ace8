"""The hybrid camera, fitted by evidence, on real captures: views that were held out, beside parametric models.

The wide lens in blocks or every other view, or all but 8 of its views in three draws; OpenCV's images with one view
left out, and their pairs, 9 fitted and 4 held out. mrcal and lensboy, of the wide lens, where KCAL_MRCAL and
KCAL_LENSBOY name interpreters that have them; elsewhere their cells stay as the page has them.

On each held-out view only its pose is solved again; camera and board stay as fitted. Measure: sqrt(sum w² |r|² / count)
over all folds, with the weights of the file (OpenCV's images: all one). Epipolar error:
Sampson's distance of held-out corners in pixels, which needs no board. *fields*: kinds of fields of the hybrid lens.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kcal import Camera, Observations, Rig, RigOptions, calibrate_rig
from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.hybrid.fit import FitOptions, fit_hybrid
from kcal.lens.field_modes import GaussianModes, NetworkModes
from kcal.lens.zernike import ZernikeModes
from kcal.nets import FieldTraining
from scripts.shared.children import interpreter
from scripts.shared.page import Lines, merged
from scripts.shared.peer_lenses import splined
from scripts.shared.real_captures import stereo_images
from scripts.shared.sections import section
from scripts.shared.wide_lens import folds, load, over_parts, warped

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
    seen, weights = load()
    weight, count = torch.from_numpy(weights), len(seen.views)
    draws = [np.random.default_rng(seed).permutation(count)[few:] for seed in (100, 101, 102)]
    splits = {words: folds(split, count) for split, words in SPLITS.items()} | {f"all but {few} views": draws}
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
    seen, weights = load()
    cases = {"wide lens, whole blocks": (seen, torch.from_numpy(weights), folds("blocks20", len(weights))[:wide_folds])}
    for side in ("left", "right"):
        weight, parts = by_views(seen := stereo_images(side))
        cases[f"{side}, each view"] = seen, weight, parts[:stereo_folds]
    yield ["field", *cases, "CPU s, wide lens"]
    for kind in kinds:
        found = [over_parts(functools.partial(by_evidence, options=KINDS[kind]), *case) for case in cases.values()]
        yield [kind, *(f"{error:.4f}" for error, _ in found), f"{found[0][1]:.1f}"]
