"""Boards whose corners are off their places one by one: found, true, and what they do to the camera.

Simulated: the traced lenses of `scripts.shared.simulated`, on a stand. Boards are exact, printed
(`PrintedBoard`), or printed with each corner off by 0.03 mm in x and y (standard deviation). *Smooth*: without the
term for single corners. Real: a camera is fitted to either half of its views with a board of smooth errors alone
(*smooth*), with single corners of its own (*default*), and with the corners that the **other** camera found in its own
views, held (*other's*). The other half is then predicted: poses are refitted, board and camera are held.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import statistics
import time
from dataclasses import dataclass

import torch
from torch import Tensor

from kcal import Observations
from kcal.calibrate.camera.calibrate import CalibrationOptions
from kcal.calibrate.hybrid.fit import FitOptions, HybridFit, fit_hybrid
from kcal.calibrate.hybrid.fitted_views import moving_residuals
from kcal.sim.captures import BoardLike, BoardSize, PrintedBoard
from scripts.shared.page import Lines
from scripts.shared.real_captures import load
from scripts.shared.sections import NOT_KEPT, Kept, Record, section
from scripts.shared.simulated import BOARD, against_truth, simulated
from scripts.shared.timing import rms, share

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
        start = time.process_time()
        found[name] = against_truth(case, options) | {"cpu_s": time.process_time() - start}
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
