"""`kcal demo`: the whole chain, on a simulated site or on a folder of real stereo pairs."""

from __future__ import annotations

import shlex
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from typer.main import get_command

from kcal.cli.calibrate import calibrate_command
from kcal.cli.console import err, out, print_table, steps
from kcal.cli.demo_practice import practice_score, practice_site
from kcal.cli.detect import detect_command
from kcal.cli.locate import locate_command
from kcal.cli.report import report_command
from kcal.cli.rig import app as rig
from kcal.errors import FileError
from kcal.files import make_folder, write_atomic

if TYPE_CHECKING:
    from kcal.corners.board import Board
    from kcal.lens.rig import StereoRig
    from kcal.locate.geodesy import Origin
    from kcal.locate.marks import Marks
    from kcal.sim.scene import DemoScene, NamedPoints


# Steps that both demonstrations share: run a command, locate the points, list the results.

SIDES = ("left", "right")


def run(name: str, *arguments: object) -> None:
    """Print a command as a user would type it, and run it: detect, calibrate, rig, locate or report."""
    words = [str(argument) for argument in arguments]
    out.print(f"\n[bold]kcal {escape(shlex.join([name, *words]))}[/]")
    app = rig
    if name != "rig":
        app = typer.Typer()
        commands = {
            "detect": detect_command,
            "calibrate": calibrate_command,
            "locate": locate_command,
            "report": report_command,
        }
        app.command()(commands[name])  # type: ignore[type-var]
    get_command(app).main(words, standalone_mode=False)


def locate_again(output: Path, *options: object) -> str:
    """Locate `points.csv`, write positions and maps, and return the command that locates the points once more."""
    words = [output / "rig.json", output / "points.csv", *options]
    files = ["-o", output / "points.geojson", "-o", output / "positions.csv"]
    run("locate", *words, *files, "--picture", output / "map.png", "--map", output / "map.html")
    return shlex.join(map(str, ["kcal", "locate", *words, "-o", "again.geojson"]))


def print_results(output: Path, command: str) -> None:
    """Print where the results are, what they are, and the command that locates the points once more."""
    out.print(f"\nResults are in {output.resolve()}:", markup=False)
    for name, what in (
        ("summary.html", "what was done and what came out, on one page"),
        ("map.png", "the map"),
        ("map.html", "the map, interactive, for any browser"),
        ("points.geojson", "positions for a GIS"),
        ("positions.csv", "the same as a table"),
        ("left.png, right.png", "coverage and residuals of each camera"),
        ("rig.json", "the rig; left.camera.json and right.camera.json are its cameras"),
    ):
        out.print(f"  {name:22s} {what}", markup=False)
    out.print(f"Locate again by hand:\n  {command}", markup=False)


# `kcal demo --images`: the whole chain on a folder of real stereo pairs of a board.


def real_pairs(
    output: Path, folder: Path, size: str, square: str, board: Board, origin: Origin | None, heading: float
) -> None:
    """Calibrate from a folder of pairs, and locate two opposite corners of each board, whose distance is known."""
    from kcal.cli.demo_summary import save_pairs_summary
    from kcal.io.rig_file import load_rig
    from kcal.lens.rig import Origin
    from kcal.locate.marks import read_marks, write_marks
    from kcal.locate.positions import locate_points
    from kcal.report.tables import diagonal_rows

    for side in SIDES:
        images = _side_images(folder, side)
        run("detect", *images, "--board", size, "--square", square, "-o", output / f"{side}.obs.json")
    for side in SIDES:
        camera, picture = output / f"{side}.camera.json", output / f"{side}.png"
        run("calibrate", output / f"{side}.obs.json", "-o", camera, "--picture", picture)
    cameras, seen = ([output / f"{side}.{kind}.json" for side in SIDES] for kind in ("camera", "obs"))
    # Few pairs: none is left out, so that each board can be compared.
    run("rig", *cameras, "--pairs", *seen, "--keep-all", "-o", output / "rig.json")

    write_marks(output / "points.csv", _board_ends(output, board))
    where = origin or Origin(lat=0.0, lon=0.0, height=0.0)
    command = locate_again(output, f"--origin={where.lat},{where.lon},{where.height}", f"--heading={heading}")
    marks = read_marks(output / "points.csv")
    rig = load_rig(output / "rig.json")
    located = locate_points(rig, marks.left, marks.right, origin=where, heading_deg=heading, names=marks.names)
    out.print("\nThe board's diagonal, true against estimated", markup=False)
    rows = diagonal_rows(located, board)
    print_table(rows)
    save_pairs_summary(output, rows, command)
    if origin is None:
        err.print("[yellow]note:[/] no --origin was given: positions are placed at latitude 0, longitude 0")
    print_results(output, command)


def _side_images(folder: Path, side: str) -> list[Path]:
    """Images of one camera: the subfolder of that name, or the files whose name begins with it."""
    from kcal.corners.images import expand_images

    if (folder / side).is_dir():
        return expand_images([folder / side])
    found = [path for path in expand_images([folder]) if path.name.lower().startswith(side)]
    if not found:
        raise FileError(f"{folder}: no folder {side}/ and no image whose name begins with {side!r}")
    return found


def _board_ends(output: Path, board: Board) -> Marks:
    """The first and last corner of each board of the rig, where both cameras saw them."""
    import torch

    from kcal.calibrate.rig.pairs import pair_by_name
    from kcal.corners.observations import Observations
    from kcal.io.rig_file import RigFile
    from kcal.locate.marks import Marks

    left, right = (Observations.load(output / f"{side}.obs.json") for side in SIDES)
    record = RigFile.load(output / "rig.json").calibration
    assert record is not None
    # A board that one camera read from its other end has other corners there: its marks would not be the same thing.
    used = set(record.per_pair_rms) - set(record.flipped)
    pairs = [
        pair
        for pair in pair_by_name(left.names, right.names)
        if any(name in used for name in (" ".join(pair), " ".join(dict.fromkeys(pair))))
    ]
    ends = [0, board.corners - 1]
    marks = [
        file.subset([pair[side] for pair in pairs]).pixels()[:, ends].reshape(-1, 2)
        for side, file in enumerate((left, right))
    ]
    names = [f"{Path(pair[0]).stem} {word}" for pair in pairs for word in ("first", "last")]
    both = torch.isfinite(torch.cat(marks, 1)).all(-1)
    chosen = tuple(name for name, seen in zip(names, both.tolist(), strict=True) if seen)
    return Marks(chosen, marks[0][both], marks[1][both])


# `kcal demo` without images: a simulated site from rendered boards to positions, and a page that explains it.


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
    from kcal.locate.positions import interval_coverage
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


def demo_command(
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for the results; made if it is missing.")
    ] = Path("kcal-demo"),
    # The draw in which the noise of the targets' marks is nearest to what is said of it, by its RMS.
    seed: Annotated[int, typer.Option(help="Seed of the simulated site's poses, noise and marks.", min=0)] = 1,
    practice: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Render a site to practise on into a folder; results are then yours."),
    ] = None,
    score: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Compare your results on a practice site with its truth, in meters."),
    ] = None,
    images: Annotated[
        Path | None, typer.Option(help="Folder of real pairs: left01.jpg with right01.jpg, or left/ and right/.")
    ] = None,
    size: Annotated[
        str, typer.Option("--board", metavar="CxR", help="With --images: inner corners, columns by rows.")
    ] = "9x6",
    square: Annotated[
        str, typer.Option("--square", metavar="LENGTH", help="With --images: side of a square with its unit.")
    ] = "25mm",
    origin: Annotated[
        str | None,
        typer.Option(
            metavar="LAT,LON,HEIGHT",
            help="With --images: position of the left camera in degrees and meters; 0,0,0 if not given.",
        ),
    ] = None,
    heading: Annotated[
        float, typer.Option(metavar="DEG", help="With --images: azimuth of the left camera's axis.")
    ] = 0.0,
) -> None:
    """Run the main job from images to positions, and compare the result with the truth.

    Without `--images` a site is rendered: two cameras 10 m apart behind ray-traced lenses, a printed board that is bent
    and stretched, twelve surveyed landmarks, and targets from 100 m to 5 km. Its pictures go through `kcal detect`,
    `kcal calibrate`, `kcal rig`, `kcal locate` and `kcal report` as yours would; the truth is used for the comparison
    only. `summary.html` says what was done and what came out.

    With `--practice` the pictures of another site are left to you: two masts' cameras with landmarks to mark, targets
    out to 5 km, boards, and a film with ships. `README.txt` there has the commands. `--score` reads your
    `left.camera.json`, `right.camera.json`, `rig.json`, `positions.geojson` (or `.csv`) and `tracks.csv` (or
    `.geojsonl`) in that folder, and says how far each is from the truth. Files that are there are never written over.

    **Examples**

    `kcal demo`

    `kcal demo --practice practice`

    `kcal demo --score practice`

    `kcal demo --images calibration/ --board 9x6 --square 25mm -o results`
    """
    if sum(each is not None for each in (practice, score, images)) > 1:
        raise typer.BadParameter("--practice, --score and --images exclude each other")
    if practice is not None:
        practice_site(practice, seed)
        return
    if score is not None:
        practice_score(score)
        return
    make_folder(output)
    if images is None:
        simulated_site(output, seed)
        return
    from kcal.corners.board import Board
    from kcal.locate.geodesy import Origin

    place = None if origin is None else Origin.parse(origin)
    real_pairs(output, images, size, square, Board.parse(size, square), place, heading)
