"""Stars: real images, identification of random points, and simulated rigs, as `docs/howto/stars.md` states them.

    python -m scripts.check.stars real --write
    python -m scripts.check.stars random 10000
    python -m scripts.check.stars rigs 30
    python -m scripts.check.stars lens 3

Real images are those of `KCAL_DATA/stars` (six of one camera; esa/tetra3). `real` compares with cedar-solve or tetra3
where one of them is installed.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from kcal.lens.rig import Origin
from kcal.stars.detect import detect_stars, read_night, time_of
from kcal.stars.lens import StarCamera, calibrate_by_stars
from kcal.stars.night import SkyView, fit_attitude, name_stars
from kcal.stars.sky import StarCatalog, identify
from scripts.shared.page import write_section
from scripts.shared.records import kept

# Trials that are done already, one a line; a run continues where another one ended.
RIGS, LENSES = (Path(os.environ.get("KCAL_TRIALS", "."), f"stars-{what}.jsonl") for what in ("rigs", "lens"))
DELFT = Origin(lat=52.0, lon=4.37, height=0.0)
_said: list[str] = []
_ABOUT = {
    "rigs": ": {count} draws of noise, survey, tape (± 2 mm), clock (± 20 ms) and air (± 3 K), over 8 pairs of traced "
    "surveillance lenses (f 1600 px, level, 10 m apart), each calibrated by 30 views of a printed board; stars of "
    "0.1 px to magnitude 6 (1 pair) and 5 (20 pairs over 8 h), matches of unknown range of 0.1 px; targets in 9 "
    "bearings along the horizon. σ and errors are of the rig alone, with exact marks",
    "lens": ": traced lenses with errors of assembly (webcam, machine vision, surveillance in turn), each calibrated "
    "by 20 views of a printed board (corners of 0.1 px), by 20 night images over 8 h (stars to magnitude 5 of 0.1 px), "
    "and by both",
}
SIZES = {(1600.0, (1920, 1080)), (5110.0, (1024, 768)), (900.0, (1280, 800))}


def say(text: str, flush: bool = True) -> None:
    """Print a line of the page."""
    print(text, flush=flush)
    _said.append(text)


def real() -> None:
    """Six real images: names, times, one lens, residuals by magnitude, and each image predicted by the others."""
    files = sorted(Path(os.environ["KCAL_DATA"], "stars").glob("*.png"))
    views = [SkyView(time=time_of("name:Z", path), origin=DELFT) for path in files]
    images, seconds = [], []
    for path in files:
        image = read_night(path)
        begin = time.process_time()
        images.append(detect_stars(image))
        seconds.append(time.process_time() - begin)
    size = (1024, 768)
    begin = time.process_time()
    whole = calibrate_by_stars(images, views, size)
    spent_on_lens, lens = time.process_time() - begin, whole.lens
    theirs = peer(files)
    say("| image | stars | named | RMS px | detect and name, CPU s | cedar-solve: stars | its RMSE | CPU s |\n"
        "|---|---|---|---|---|---|---|---|")  # fmt: skip
    for path, view in zip(files, views, strict=True):
        image = read_night(path)
        begin = time.process_time()
        found = name_stars(image, lens.camera, view)
        spent = time.process_time() - begin
        stars = found.attitude
        told = theirs.get(path, "not installed | |")
        name = path.stem.split("_", 1)[-1]
        say(f"| {name} | {len(found.detected.pixels)} | {stars.count} | {stars.rms_px:.3f} | {spent:.2f} | {told} |")
        for text in found.warnings:
            say(f"\n{path.stem}: {text}\n")
    say("\n| magnitude | stars | RMS along an axis, px |\n|---|---|---|")
    by_magnitude(whole)
    say("")
    say(f"detection {np.mean(seconds):.2f} CPU s an image; lens and names {spent_on_lens:.0f}")
    say(f"{len(whole.images)} of {len(files)} images, {sum(int(u.sum()) for u in lens.used)} stars, "
          f"{sum(int((~u).sum()) for u in lens.used)} left out, RMS along an axis {lens.rms_px:.4f} px, "
          f"{lens.effective:.1f} effective unknowns, f {float(lens.camera.params[0]):.2f} px")  # fmt: skip
    held_out(images, views, size, float(lens.camera.params[0]))


def by_magnitude(whole: StarCamera) -> None:
    """RMS residual of the stars of each magnitude."""
    magnitude = np.concatenate([StarCatalog.bundled().magnitude[star] for star in whole.stars])
    error = torch.cat(whole.lens.residuals).numpy()
    for low, high in ((-2, 4), (4, 5), (5, 6), (6, 8)):
        some = (magnitude >= low) & (magnitude < high)
        if some.any():
            rms = np.sqrt((error[some] ** 2).mean())
            say(f"| {low} to {high} | {some.sum()} | {rms:.3f} |")


def held_out(images: list, views: list, size: tuple[int, int], focal: float) -> None:
    """One lens of five images predicts the sixth: its attitude by every other star, residuals of the others."""
    catalog, errors = StarCatalog.bundled(), []
    for out in range(len(images)):
        rest = [k for k in range(len(images)) if k != out]
        camera = calibrate_by_stars([images[k] for k in rest], [views[k] for k in rest], size, focal=focal).lens.camera
        named = name_stars(images[out], camera, views[out])
        use = np.flatnonzero(named.attitude.star >= 0)
        directions = named.directions
        for half in (0, 1):
            ours, theirs = use[half::2], use[1 - half :: 2]
            best = fit_attitude(
                images[out].pixels[ours], images[out].sigma[ours], directions, catalog.magnitude, camera,
                named.attitude.rotation.numpy(),
            )  # fmt: skip
            if best is None:
                continue
            at, _ = camera.project(1e9 * torch.from_numpy(directions[named.attitude.star[theirs]]) @ best.rotation.T)
            errors.append(at.numpy() - images[out].pixels[theirs])
    error = np.concatenate(errors)
    rms = np.sqrt((error**2).mean())
    say(f"held out: {len(error)} stars of {len(images)} images, RMS along an axis {rms:.3f} px, "
          f"median distance {np.median(np.linalg.norm(error, axis=1)):.3f} px")  # fmt: skip


def peer(files: list[Path]) -> dict[Path, str]:
    """Cells of the table: cedar-solve or tetra3 on the same images; nothing where neither is installed."""
    try:
        import tetra3  # type: ignore[import-not-found, unused-ignore]
    except ImportError:
        return {}
    from PIL import Image

    np.math = math  # type: ignore[attr-defined]  # cedar-solve 0.5 uses what numpy 2 does not have
    solver, told = tetra3.Tetra3(), {}
    for path in files:
        begin = time.process_time()
        found = solver.solve_from_image(Image.open(path), fov_estimate=11.4, fov_max_error=1.0)
        spent = time.process_time() - begin
        rmse = found.get("RMSE")
        told[path] = f"{found.get('Matches')} | {'' if rmse is None else f'{rmse:.1f}″'} | {spent:.2f}"
    return told


def random_points(count: int) -> None:
    """False names of random points: of 4 to 20 points each, seen by three cameras in turn."""
    generator, wrong, begin = np.random.default_rng(34), 0, time.process_time()
    cameras = sorted(SIZES)
    for number in range(count):
        focal, size = cameras[number % len(cameras)]
        pixels = generator.random((int(generator.integers(4, 21)), 2)) * size
        rays = np.c_[(pixels - np.array(size) / 2) / focal, np.ones(len(pixels))]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        field = 2 * math.atan(math.hypot(*size) / 2 / focal)
        wrong += identify(rays, 2.5 / focal, field=field) is not None
        if (number + 1) % 500 == 0:
            print(number + 1, wrong, flush=True)
    spent = (time.process_time() - begin) / count
    say(f"{count} fields of 4 to 20 random points: {wrong} with names; {spent:.2f} CPU s each")


def rigs(count: int) -> None:
    """Ranges of rigs behind traced lenses that boards calibrated: errors, and coverage of their 95 % intervals."""
    from scripts.shared.traced_nights import CASES, PAIRS_OF_LENSES, trial

    def run(seed: int) -> dict[str, Any]:
        return {case.name: trial(200 + seed % PAIRS_OF_LENSES, case, seed).tolist() for case in CASES}

    found = kept(RIGS, [case.name for case in CASES], range(count), run)
    say("| rig from a taped baseline and | σ, % of range at 1, 2, 5 km | RMS error | error over σ | truth in the rig's "
        "95 % | with marks by day ± 0.1 px |\n|---|---|---|---|---|---|")  # fmt: skip
    for name, trials in found.items():
        mean = np.mean(trials, axis=0)
        cells = [
            " / ".join(f"{factor * value:.{digits}f}" for value in values)
            for values, factor, digits in (
                (np.sqrt(mean[:, 0]), 100, 2), (np.sqrt(mean[:, 1]), 100, 2), (np.sqrt(mean[:, 1] / mean[:, 0]), 1, 2),
                (mean[:, 2], 100, 0), (mean[:, 3], 100, 0),
            )
        ]  # fmt: skip
        say(f"| {name} | {' | '.join(cells)} |")


def lens(count: int) -> None:
    """A lens from boards, stars, and both, against the traced one at infinity; level and tilted by 30°."""
    from scripts.shared.star_lenses import LENSES_FROM, lens_trials

    def run(seed: int) -> dict[str, Any]:
        return {name: list(trial) for name, trial in lens_trials(seed).items()}

    found = kept(LENSES, LENSES_FROM, range(count), run)
    say("| from | error at infinity, px: median of the RMS | largest RMS | largest anywhere | inside 95 % "
        "| χ² of boards against stars, over its freedom | contradictions |\n|---|---|---|---|---|---|---|")  # fmt: skip
    for name, trials in found.items():
        rms, largest, inside, chi2, contradiction = (np.array(column) for column in zip(*trials, strict=True))
        told = f"{chi2.mean():.2f} | {contradiction.sum()}" if np.isfinite(chi2).all() else "|"
        say(f"| {name} | {np.median(rms):.4f} | {rms.max():.4f} | {largest.max():.3f} | {100 * inside.mean():.1f} % "
            f"| {told} |")  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("real", "random", "rigs", "lens"))
    parser.add_argument("count", type=int, nargs="?", default=30, help="points, rigs or lenses; real images are six")
    parser.add_argument("--write", action="store_true", help="put the result into docs/measured/stars.md")
    options = parser.parse_args()
    what, count = options.what, options.count
    if what == "real":
        real()
    else:
        {"random": random_points, "rigs": rigs, "lens": lens}[what](count)
    if options.write:
        words = f"{what} --write" if what == "real" else f"{what} {count} --write"
        made = f"Made by `python -m scripts.check.stars {words}`{_ABOUT.get(what, '').format(count=count)}."
        write_section("stars.md", what, made + "\n\n" + "\n".join(_said))
