"""`kcal demo` without images: a simulated site from rendered boards to positions, and a page that explains it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

from kcal.cli.console import out, print_table, steps
from kcal.cli.demo_steps import SIDES, locate_again, print_results, run
from kcal.files import make_folder, write_atomic

if TYPE_CHECKING:
    from kcal.lens.rig import StereoRig
    from kcal.sim.scene import DemoScene, NamedPoints


def simulated_site(output: Path, seed: int) -> None:
    """Render the site of a seed, run the whole chain, compare with the truth, and write everything to a folder."""
    from kcal.cli.demo_summary import REQUIREMENT, save_site_summary
    from kcal.io.rig_file import load_rig
    from kcal.locate.marks import Marks, write_marks
    from kcal.locate.positions import locate_points
    from kcal.report.tables import chance_text, truth_rows
    from kcal.sim.scene import DemoScene

    clock = _Clock()
    scene = DemoScene(seed=seed)
    out.print(
        f"A simulated site: two cameras {float(scene.rig.baseline):.3f} m apart behind ray-traced lenses, "
        f"{scene.near_views} views of a printed board by each, {len(scene.landmarks.names)} surveyed landmarks, "
        f"{len(scene.targets.names)} targets."
    )
    _render(scene, output / "images")
    clock.lap("rendering")
    board = scene.near_board
    size = "--board", f"{board.columns}x{board.rows}", "--square", f"{1e3 * board.square:g}mm"
    for side in SIDES:
        run("detect", output / "images" / f"{side}-near", *size, "-o", output / f"{side}.obs.json")
    clock.lap("detection")
    for side in SIDES:
        camera, picture = output / f"{side}.camera.json", output / f"{side}.png"
        run("calibrate", output / f"{side}.obs.json", "-o", camera, "--name", side, "--picture", picture)
    clock.lap("calibration")
    _write_places(output / "survey.csv", scene.surveyed(scene.landmarks), sigma=scene.survey_sigma)
    marks = scene.landmark_marks
    write_marks(output / "landmarks.csv", Marks(scene.landmarks.names, marks.left, marks.right))
    run(
        "rig", *(output / f"{side}.camera.json" for side in SIDES),
        "--landmarks", output / "survey.csv", "--marks", output / "landmarks.csv", "--pixel-sigma", scene.mark_sigma,
        f"--origin={scene.lat},{scene.lon},{scene.height}", "-o", output / "rig.json", "--picture", output / "rig.png",
        # The simulated light goes straight.
        "--refraction=0", "--refraction-sigma=0",
    )  # fmt: skip
    clock.lap("rig")

    marks, targets = scene.target_marks, scene.targets
    write_marks(output / "points.csv", Marks(targets.names, marks.left, marks.right))
    _write_places(output / "truth.csv", targets)
    command = locate_again(output, "--pixel-sigma", scene.mark_sigma, "--truth", output / "truth.csv")
    rig = load_rig(output / "rig.json")
    located, exact = (
        locate_points(rig, *pixels, pixel_sigma=scene.mark_sigma, names=targets.names)
        for pixels in ((marks.left, marks.right), (marks.true_left, marks.true_right))
    )
    clock.lap("positions and maps")
    rows, chance = truth_rows(located, exact, targets.enu), chance_text(located, targets.enu)
    out.print("\nTrue against estimated positions", markup=False)
    print_table(rows)
    out.print(
        f"Marks have {scene.mark_sigma:g} px of noise in each image; the interval includes it and the errors of the "
        "rig. The last column is the error with marks that have no noise: the calibration's share."
    )
    chance += f" {_more_draws(scene, rig)}"
    out.print(chance, markup=False)
    run("report", output / "rig.json", "--require", REQUIREMENT, "--pixel-sigma", scene.mark_sigma)
    save_site_summary(output, scene, rows, chance, command)
    out.print(f"Time: {clock.text()}.")
    print_results(output, command)


def _more_draws(scene: DemoScene, rig: StereoRig) -> str:
    """How many intervals of this rig contain the true range over many draws of the noise in the marks."""
    from kcal.locate.localizer import StereoLocalizer
    from kcal.locate.truth import interval_coverage
    from kcal.sim.scene import mark_points

    draws, targets = 200, scene.points_rig(scene.targets)
    marks = mark_points(scene.rig, targets.repeat(draws, 1), scene.mark_sigma, scene.generator(-30))
    ranges = targets.norm(dim=-1).repeat(draws)
    localize = StereoLocalizer(rig, pixel_sigma=scene.mark_sigma)
    share = interval_coverage(localize, marks.left, marks.right, ranges)
    return f"With {draws} other draws of the noise in the marks, {100 * share:.0f} % of the intervals contain it."


class _Clock:
    """Seconds of each stage."""

    def __init__(self) -> None:
        self._laps: list[tuple[str, float]] = []
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self._laps.append((name, now - self._last))
        self._last = now

    def text(self) -> str:
        parts = [f"{name} {seconds:.1f} s" for name, seconds in self._laps]
        return ", ".join([*parts, f"together {sum(seconds for _, seconds in self._laps):.1f} s"])


def _render(scene: DemoScene, folder: Path) -> None:
    """Write the site's images, a folder for each camera."""
    from kcal.io.images import write_png
    from kcal.sim.scene import render_demo

    with steps("rendering", scene.images) as advance:
        for view in render_demo(scene, advance):
            place = make_folder(folder / f"{view.camera}-near")
            write_png(place / f"{view.name}.png", view.image.numpy())


def _write_places(path: Path, points: NamedPoints, sigma: float | None = None) -> None:
    """Write places as a surveyor hands them over, to a millimeter with a sigma, and exactly without."""
    lines = ["name,east,north,up" if sigma is None else "name,east,north,up,sigma"]
    for name, place in zip(points.names, points.enu.tolist(), strict=True):
        exact = map(repr, place)
        lines.append(",".join([name, *(exact if sigma is None else (*(f"{v:.3f}" for v in place), f"{sigma:g}"))]))
    write_atomic(path, "\n".join(lines) + "\n")
