"""Boards whose corners are off their places one by one: found, true, and what they do to the camera.

    python -m scripts.check.board_corners --out FILE --seeds 0-99              # simulated boards
    KCAL_DATA=DATA python -m scripts.check.board_corners --out FILE --real     # captures by two cameras of one board
    python -m scripts.check.board_corners --out FILE --write                   # the tables of one-camera.md

Simulated: the traced lenses of `scripts.shared.simulated`, on a stand. Boards are exact, printed
(`PrintedBoard`), or printed with each corner off by 0.03 mm in x and y (standard deviation). *Smooth*: without the
term for single corners. Real: a camera is fitted to either half of its views with a board of smooth errors alone
(*smooth*), with single corners of its own (*default*), and with the corners that the **other** camera found in its own
views, held (*other's*). The other half is then predicted: poses are refitted, board and camera are held.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import math
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from kcal import Observations
from kcal.calibrate.camera.calibrate import CalibrationOptions
from kcal.calibrate.hybrid.fit import FitOptions, HybridFit, fit_hybrid
from kcal.calibrate.hybrid.fitted_views import moving_residuals
from kcal.sim.captures import BoardLike, BoardSize, PrintedBoard
from scripts.check.captures_that_move import rms, share
from scripts.shared.page import table, tell
from scripts.shared.real_captures import data_folder, load
from scripts.shared.records import Record, finish, read, seeds
from scripts.shared.simulated import BOARD, against_truth, simulated

PAGE, NOISES, OFF, VIEWS = "one-camera.md", (0.08,), 3e-5, (8, 30)
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


def real(name: str, other: str, cache: Path) -> Record:
    """One camera of a pair."""
    seen, theirs = (load(each, data_folder(), cache).seen for each in (name, other))
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


def simulated_lines(records: list[Record]) -> list[str]:
    """A row for each kind of board, number of views and fit."""
    rows, cells = [], dict[tuple[str, float, int], list[Record]]()
    for record in records:
        cells.setdefault(tuple(record["key"][:3]), []).append(record)
    for (kind, noise, views), own in sorted(cells.items(), key=lambda cell: cell[0][::-1]):
        for fit in ("smooth", "default"):
            known = [record[fit] for record in own if "refused" not in record[fit]]
            found = statistics.fmean("corners" in record["terms"] for record in known)
            true, stated = [record["rms"] for record in known], [record["predicted"] for record in known]
            rows.append([
                views, noise, kind, fit, len(own), f"{100 * found:.0f} %" if fit == "default" else "–",
                share(known, "everywhere"), f"{statistics.median(true):.3f}", f"{rms(true):.3f}", f"{rms(stated):.3f}",
                f"{statistics.fmean(record['cpu_s'] for record in known):.2f}",
            ])  # fmt: skip
    head = [
        "views", "noise, px", "board", "fit", "captures", "found", "in 95 %, whole image", "median error, px",
        "RMS error", "RMS stated", "CPU s",
    ]  # fmt: skip
    return table(head, rows)


def real_lines(records: list[Record]) -> list[str]:
    """A row for each camera."""
    rows = []
    for record in records:
        cells = [f"{record['off_mm']:.3f}", f"{record['correlation']:.2f}"] if "off_mm" in record else ["–", "–"]
        cells += [" / ".join(f"{value:.4f}" for value in record["rms"].values())]
        held = [math.sqrt(statistics.fmean(v * v for v in values)) for values in record.get("held", {}).values()]
        cells += [" / ".join(f"{value:.4f}" for value in held) or "–"]
        rows.append([record["key"][1], *cells, f"{record['moved']:.1f}" if "moved" in record else "–"])
    head = [
        "camera", "corners are off, mm", "correlation with the other's", "RMS, px: smooth / default / other's",
        "held out: smooth / default / other's", "f, c moved by at most, σ",
    ]  # fmt: skip
    return table(head, rows)


def line(record: Record) -> str:
    """One line to print."""
    if "rms" in record:
        return str(record)
    told = [
        f"{name} {one.get('rms', math.nan):.3f} {one.get('terms')}" for name, one in record.items() if name != "key"
    ]
    return ", ".join(told)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", nargs="+", type=Path, required=True, help="JSON lines; the first is written to")
    parser.add_argument("--seeds", type=seeds, help="for example 0-99")
    parser.add_argument("--kinds", nargs="+", choices=("exact", "printed", "corners"), default=["exact", "corners"])
    parser.add_argument("--views", nargs="+", type=int, default=VIEWS)
    parser.add_argument("--noises", nargs="+", type=float, default=NOISES, help="pixels")
    parser.add_argument("--real", action="store_true", help="the pairs of cameras in KCAL_DATA")
    parser.add_argument(
        "--cache",
        type=Path,
        default=Path(tempfile.gettempdir(), "kcal-ordinary-corners"),
        help="corners found in images",
    )
    parser.add_argument("--write", action="store_true", help="write the tables into the page")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.seeds is not None:
        keys = [*itertools.product(arguments.kinds, arguments.noises, arguments.views, arguments.seeds)]
        finish(arguments.out[0], sorted(keys, key=lambda key: int(str(key[3]))), simulation, line)
    if arguments.real:
        pairs = [("real", *names) for pair in PAIRS for names in (pair, pair[::-1])]
        finish(arguments.out[0], pairs, lambda _, one, other: real(one, other, arguments.cache), line)
    records = read(arguments.out)
    for section, is_real, text in (("board-corners-real", True, real_lines), ("board-corners", False, simulated_lines)):
        own = [record for record in records if (record["key"][0] == "real") is is_real]
        if own:
            tell(PAGE, section, text(own), write=arguments.write)


if __name__ == "__main__":
    main()
