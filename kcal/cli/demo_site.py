"""`kcal demo` without images: a simulated site from rendered boards to positions, and a page that explains it."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import TYPE_CHECKING

from kcal.cli.console import out, print_table, steps
from kcal.cli.demo_steps import SIDES, locate_again, print_results, run
from kcal.files import make_folder, write_atomic

if TYPE_CHECKING:
    from kcal.locate.positions import Located
    from kcal.sim.scene import DemoScene, NamedPoints


def simulated_site(output: Path, seed: int) -> None:
    """Render the site of a seed, run the whole chain, compare with the truth, and write everything to a folder."""
    from kcal.io.rig_file import load_rig
    from kcal.locate.marks import Marks, write_marks
    from kcal.locate.positions import locate_points
    from kcal.report.tables import truth_rows
    from kcal.sim.scene import DemoScene

    clock = _Clock()
    scene = DemoScene(seed=seed)
    out.print(
        f"A simulated site: two cameras {float(scene.rig.baseline):.3f} m apart behind ray-traced lenses, "
        f"{scene.near_views} close views by each camera, {scene.pair_views} views of a large board by both, "
        f"{len(scene.landmarks.names)} surveyed landmarks, {len(scene.targets.names)} targets."
    )
    _render(scene, output / "images")
    clock.lap("rendering")
    boards = {"near": scene.near_board, "pair": scene.pair_board}
    for side in SIDES:
        for kind, board in boards.items():
            size = "--board", f"{board.columns}x{board.rows}", "--square", f"{board.square}m"
            run("detect", output / "images" / f"{side}-{kind}", *size, "-o", output / f"{side}.{kind}.obs.json")
    clock.lap("detection")
    for side in SIDES:
        camera, picture = output / f"{side}.camera.json", output / f"{side}.png"
        run("calibrate", output / f"{side}.near.obs.json", "-o", camera, "--name", side, "--picture", picture)
    clock.lap("calibration")
    _write_places(output / "survey.csv", scene.surveyed(scene.landmarks), sigma=scene.survey_sigma)
    marks = scene.landmark_marks
    write_marks(output / "landmarks.csv", Marks(scene.landmarks.names, marks.left, marks.right))
    cameras, pairs = ([output / f"{side}.{kind}.json" for side in SIDES] for kind in ("camera", "pair.obs"))
    run(
        "rig", *cameras, "--pairs", *pairs,
        "--landmarks", output / "survey.csv", "--marks", output / "landmarks.csv", "--mark-sigma", scene.mark_sigma,
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
    rows = truth_rows(located, exact, targets.enu)
    out.print("\nTrue against estimated positions", markup=False)
    print_table(rows)
    out.print(
        f"Marks have {scene.mark_sigma:g} px of noise in each image. The interval includes that and the errors of the "
        "rig and its mounting. The last column is the error that the same rig makes with marks that have no noise: the "
        "calibration's share."
    )
    _write_summary(output, scene, rows, command, located)
    out.print(f"Time: {clock.text()}.")
    print_results(output, command, summary=True)


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
    """Write the site's images, a folder for each camera and kind of board."""
    from kcal.io.images import write_png
    from kcal.sim.scene import render_demo

    with steps("rendering", scene.images) as advance:
        for view in render_demo(scene, advance):
            place = make_folder(folder / f"{view.camera}-{view.kind}")
            write_png(place / f"{view.name}.png", view.image.numpy())


def _write_places(path: Path, points: NamedPoints, sigma: float | None = None) -> None:
    """Write places as a surveyor hands them over, to a millimeter with a sigma, and exactly without."""
    lines = ["name,east,north,up" if sigma is None else "name,east,north,up,sigma"]
    for name, place in zip(points.names, points.enu.tolist(), strict=True):
        exact = map(repr, place)
        lines.append(",".join([name, *(exact if sigma is None else (*(f"{v:.3f}" for v in place), f"{sigma:g}"))]))
    write_atomic(path, "\n".join(lines) + "\n")


def _write_summary(output: Path, scene: DemoScene, table: list[list[str]], command: str, located: Located) -> None:
    from kcal.corners.observations import Observations
    from kcal.io.rig_file import RigFile
    from kcal.locate.range_sigmas import range_sigmas
    from kcal.locate.truth import position_errors
    from kcal.report.summary import Part, save_summary

    found = sum(len(Observations.load(output / f"{side}.near.obs.json").views) for side in SIDES)
    rig = RigFile.load(output / "rig.json")
    solved = rig.rig()
    sigmas = range_sigmas(solved, [5000.0], pixel_sigma=scene.mark_sigma)
    calibration = math.hypot(float(sigmas.lenses[0]), float(sigmas.pose[0]))
    cameras = zip(SIDES, (rig.left.calibration, rig.right.calibration), strict=True)
    rms = ", ".join(f"{side} {record.rms:.3f} px" for side, record in cameras if record is not None)
    pairs = 0 if rig.calibration is None else rig.calibration.pairs
    inside = sum(miss is not None and miss[2] for miss in position_errors(located, scene.targets.enu))
    parts = [
        Part(
            heading="What came out",
            text=(
                f"{located.count} of {len(located.positions)} targets were located from one pair of pixels each. Their "
                f"pixels were marked with {scene.mark_sigma:g} px of noise, and at long range that decides: a tenth of "
                "a pixel of disparity is 156 m at 5 km. The interval should contain the true range in 19 cases of 20; "
                f"here it does in {inside} of {located.count}. 'Across' is the error across the line of "
                "sight. The last column is the error that is left when the marks have no noise: what the calibration "
                "itself does.",
            ),
            table=tuple(map(tuple, table)),
        ),
        Part(
            heading="The map",
            text=("Seen from above, north up; ranges are drawn logarithmically. map.html beside this page can be moved "
                  "and zoomed.",),
            pictures=((output / "map.png", "True positions, estimates, and the error of each range"),),
        ),
        Part(
            heading="1. Each camera was calibrated",
            text=(
                f"A board was photographed {scene.near_views} times by each camera; it was found in {found} of "
                f"{2 * scene.near_views} pictures. What the lens model leaves over is small: {rms}. The truth is a "
                "lens traced ray by ray through seven pieces of glass that are not quite centered.",
            ),
            pictures=(
                (output / "images" / "left-near" / "near-02.png", "One of the pictures"),
                (output / "left.png", "Left camera: where corners were, and what is left over"),
            ),
        ),
        Part(
            heading="2. The rig was solved",
            text=(
                f"A large board seen by both cameras ({pairs} times) and {len(scene.landmarks.names)} "
                f"landmarks surveyed to {100 * scene.survey_sigma:g} cm tell where the cameras stand and look: "
                f"baseline {float(solved.baseline):.4f} m (true {float(scene.rig.baseline):.4f} m), "
                f"what is not known of lenses and pose is {calibration:.0f} m of range at 5 km, noise in the marks "
                f"{float(sigmas.marks[0]):.0f} m (one sigma).",
            ),
            pictures=((output / "rig.png", "What is left over, by source"),),
        ),
        Part(
            heading="3. Do it yourself",
            text=(
                "Print a board (kcal board), photograph it, and go on as the README shows. With the files in this "
                "folder:",
            ),
            code=command,
        ),
    ]  # fmt: skip
    lead = (
        "kcal rendered a site whose truth is known, calibrated two cameras from its own pictures of boards, solved the "
        "rig, and located seven targets. Nothing but the pictures and a surveyor's list was used; the truth comes in "
        "only here, for the comparison."
    )
    save_summary(output / "summary.html", "Two cameras, seven targets, 100 m to 5 km", lead, parts)
