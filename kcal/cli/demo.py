"""`kcal demo`: the whole chain, on a simulated site or on a folder of real stereo pairs, and what came out of it."""

from __future__ import annotations

import itertools
import math
import shlex
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import typer
from typer.main import get_command

import kcal
from kcal.cli import kinds, rooms
from kcal.cli.board import detect_command
from kcal.cli.calibrate import calibrate_command
from kcal.cli.console import out, print_label, print_styled, print_table, steps
from kcal.cli.locate import locate_command
from kcal.cli.options import Command, Kind, declared
from kcal.cli.report import report_command
from kcal.cli.rig import rig_solve_command
from kcal.errors import FileError
from kcal.files import make_folder, write_atomic
from kcal.texts import length_text


def demo_command(
    *,
    output: kinds.Output = Path("kcal-demo"),
    # The draw in which the noise of the targets' marks is nearest to what is said of it, by its RMS.
    seed: Annotated[int, Kind(least=0)] = 1,
    practice: Annotated[Path | None, Kind(metavar="FOLDER")] = None,
    score: Annotated[Path | None, Kind(metavar="FOLDER")] = None,
    images: Path | None = None,
    board: Annotated[str, Kind(metavar="CxR", of="images")] = "9x6",
    square: Annotated[str, Kind(metavar="LENGTH", of="images")] = "25mm",
    site: Annotated[kinds.Place, Kind(of="images")] | None = None,
    heading: Annotated[kinds.Degrees, Kind(of="images")] = 0.0,
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

    Args:
        output: Folder for the results; made if it is missing.
        seed: Seed of the simulated site's poses, noise and marks.
        practice: Render a site to practise on into a folder; results are then yours.
        score: Compare your results on a practice site with its truth, in meters.
        images: Folder of real pairs: left01.jpg with right01.jpg, or left/ and right/.
        board: With --images: inner corners, columns by rows.
        square: With --images: side of a square with its unit.
        site: With --images: where the left camera stands; 0,0,0 if not given.
        heading: With --images: azimuth of the left camera's axis.
    """
    if sum(each is not None for each in (practice, score, images)) > 1:
        raise typer.BadParameter("--practice, --score and --images exclude each other")
    if practice is not None or score is not None:
        from kcal.cli.demo_practice import practice_score, practice_site

        if practice is not None:
            practice_site(practice, seed)
        elif score is not None:
            practice_score(score)
        return
    make_folder(output)
    if images is None:
        simulated_site(output, seed)
        return

    place = None if site is None else site.origin
    real_pairs(output, images, board, square, kcal.Board.parse(board, square), place, heading)


# What the rig of the simulated site must do.
REQUIREMENT = "5km:10%"
SIDES = ("left", "right")


def _save_site_summary(output: Path, scene: rooms.DemoScene, table: list[list[str]], chance: str, command: str) -> None:
    """That of the simulated site, with true and estimated positions and how many intervals contain the truth."""
    file = rooms.RigFile.load(output / "rig.json")
    rig, needs = file.rig(), kcal.report.Requirement.parse(REQUIREMENT)
    (answer,) = kcal.report.rig_verdict(rig, needs, mark_sigma=scene.mark_sigma).answers
    calibration = math.hypot(answer.parts["lenses"], answer.parts["relative pose"])
    rooms.save_summary(
        output / "summary.html", "demo_site_page", folder=output, scene=scene, table=table, chance=chance,
        command=command, answer=answer, residuals=_residuals_text(file),
        found=sum(len(kcal.Observations.load(output / f"{side}.obs.json").views) for side in SIDES),
        marks=length_text(answer.parts["marks"], digits=2), calibration=length_text(calibration, digits=2),
        baseline=length_text(float(rig.baseline), digits=5),
        true_baseline=length_text(float(scene.rig.baseline), digits=5),
    )  # fmt: skip


def _residuals_text(file: rooms.RigFile) -> str:
    cameras = zip(SIDES, [camera.calibration for camera in file.cameras], strict=True)
    rms = ", ".join(f"{side} {record.rms:.3f} px" for side, record in cameras if record is not None)
    return f"RMS of the residuals: {rms}."


# Steps that both demonstrations share: run a command, locate the points, list the results.

_COMMANDS: dict[str, Callable[..., None]] = {
    "detect": detect_command, "calibrate": calibrate_command, "rig": rig_solve_command, "locate": locate_command,
    "report": report_command,
}  # fmt: skip


def run(name: str, *arguments: object) -> None:
    """Print a command as a user would type it, and run it, without what kcal.toml says."""
    words = [str(argument) for argument in arguments]
    print_styled(f"\nkcal {shlex.join([name, *words])}", ".+")
    app = typer.Typer()
    app.command(cls=Command)(declared(_COMMANDS[name]))
    get_command(app).main(words, standalone_mode=False)


def _calibrate_both(
    output: Path, images: dict[str, list[Path]], board: Sequence[str], lap: Callable[[str], object] = lambda _: None
) -> None:
    """Detect the board in the images of each camera, and calibrate; `lap` is told what was done."""
    for side in SIDES:
        run("detect", *images[side], *board, "-o", output / f"{side}.obs.json")
    lap("detection")
    for side in SIDES:
        camera, picture = output / f"{side}.camera.json", output / f"{side}.png"
        run("calibrate", output / f"{side}.obs.json", "-o", camera, "--picture", picture)
    lap("calibration")


def locate_again(output: Path, *options: object) -> str:
    """Locate `points.csv`, write positions and maps, and return the command that locates the points once more."""
    words = [output / "rig.json", output / "points.csv", *options]
    files = ["-o", output / "points.geojson", "-o", output / "positions.csv"]
    run("locate", *words, *files, "--picture", output / "map.png", "--map", output / "map.html")
    return shlex.join(map(str, ["kcal", "locate", *words, "-o", "again.geojson"]))


def print_results(output: Path, command: str) -> None:
    """Print where the results are, what they are, and the command that locates the points once more."""
    out.print(f"\nResults are in {output.resolve()}:")
    for name, what in (
        ("summary.html", "what was done and what came out, on one page"),
        ("map.png", "the map"),
        ("map.html", "the map, interactive, for any browser"),
        ("points.geojson", "positions for a GIS"),
        ("positions.csv", "the same as a table"),
        ("left.png, right.png", "coverage and residuals of each camera"),
        ("rig.json", "the rig; left.camera.json and right.camera.json are its cameras"),
    ):
        out.print(f"  {name:22s} {what}")
    out.print(f"Locate again by hand:\n  {command}")


# `kcal demo --images`: the whole chain on a folder of real stereo pairs of a board.


def real_pairs(
    output: Path, folder: Path, size: str, square: str, board: kcal.Board, origin: kcal.Origin | None, heading: float
) -> None:
    """Calibrate from a folder of pairs, and locate two opposite corners of each board, whose distance is known."""
    images = {side: _side_images(folder, side) for side in SIDES}
    _calibrate_both(output, images, ("--board", size, "--square", square))
    cameras, seen = ([output / f"{side}.{kind}.json" for side in SIDES] for kind in ("camera", "obs"))
    # Few pairs: none is left out, so that each board can be compared.
    run("rig", *cameras, "--pairs", *seen, "--keep-all", "-o", output / "rig.json")

    rooms.write_marks(output / "points.csv", _board_ends(output, board))
    where = origin or kcal.Origin(lat=0.0, lon=0.0, height=0.0)
    command = locate_again(output, f"--site={where.lat},{where.lon},{where.height}", f"--heading={heading}")
    marks = kcal.locate.read_marks(output / "points.csv")
    rig = rooms.load_pair(output / "rig.json")
    located = kcal.locate_points(kcal.Localizer(rig.placed(origin=where, heading_deg=heading)), marks)
    out.print("\nThe board's diagonal, true against estimated")
    rows = rooms.diagonal_rows(located, board)
    print_table(rows)
    file = rooms.RigFile.load(output / "rig.json")
    rooms.save_summary(
        output / "summary.html", "demo_pairs_page", folder=output, table=rows, command=command,
        residuals=_residuals_text(file), pairs=0 if file.calibration is None else file.calibration.pairs,
        baseline=length_text(float(rig.baseline), digits=5),
    )  # fmt: skip
    if origin is None:
        print_label("note", "no --site was given: positions are placed at latitude 0, longitude 0")
    print_results(output, command)


def _side_images(folder: Path, side: str) -> list[Path]:
    """Images of one camera: the subfolder of that name, or the files whose name begins with it."""
    if (folder / side).is_dir():
        return rooms.expand_images([folder / side])
    found = [path for path in rooms.expand_images([folder]) if path.name.lower().startswith(side)]
    if not found:
        raise FileError(f"{folder}: no folder {side}/ and no image whose name begins with {side!r}")
    return found


def _board_ends(output: Path, board: kcal.Board) -> kcal.locate.Marks:
    """The first and last corner of each board of the rig, where both cameras saw them."""
    left, right = (kcal.Observations.load(output / f"{side}.obs.json") for side in SIDES)
    record = rooms.RigFile.load(output / "rig.json").calibration
    assert record is not None
    # A board that one camera read from its other end has other corners there: its marks would not be the same point.
    used = set(record.per_pair_rms) - set(record.flipped)
    pairs = [
        pair
        for pair in kcal.rig.pair_by_name(left.names, right.names)
        if any(name in used for name in (" ".join(pair), " ".join(dict.fromkeys(pair))))
    ]
    ends = [0, board.corners - 1]
    marks = [
        file.subset([pair[side] for pair in pairs]).pixels()[:, ends].reshape(-1, 2)
        for side, file in enumerate((left, right))
    ]
    names = [f"{Path(pair[0]).stem} {word}" for pair in pairs for word in ("first", "last")]
    both = rooms.torch.isfinite(rooms.torch.cat(marks, 1)).all(-1)
    chosen = tuple(name for name, seen in zip(names, both.tolist(), strict=True) if seen)
    return kcal.locate.Marks.of_pair(chosen, marks[0][both], marks[1][both])


# `kcal demo` without images: a simulated site from rendered boards to positions, and a page that explains it.


def simulated_site(output: Path, seed: int) -> None:
    """Render the site of a seed, run the whole chain, compare with the truth, and write everything to a folder."""
    laps = {"": time.perf_counter()}

    def lap(name: str) -> None:
        laps[name] = time.perf_counter()

    scene = rooms.DemoScene(seed=seed)
    out.print(
        f"A simulated site: two cameras {float(scene.rig.baseline):.3f} m apart behind ray-traced lenses, "
        f"{scene.near_views} views of a printed board by each, {len(scene.landmarks.names)} surveyed landmarks, "
        f"{len(scene.targets.names)} targets."
    )
    with steps("rendering", scene.images) as advance:
        for view in rooms.render_demo(scene, advance):
            place = make_folder(output / "images" / f"{view.camera}-near")
            rooms.write_png(place / f"{view.name}.png", view.image.numpy())
    lap("rendering")
    board = scene.near_board
    size = "--board", f"{board.columns}x{board.rows}", "--square", f"{1e3 * board.square:g}mm"
    _calibrate_both(output, {side: [output / "images" / f"{side}-near"] for side in SIDES}, size, lap)
    _write_places(output / "survey.csv", scene.surveyed(scene.landmarks), sigma=scene.survey_sigma)
    marks = scene.landmark_marks
    landmarks = kcal.locate.Marks.of_pair(scene.landmarks.names, marks.left, marks.right)
    rooms.write_marks(output / "landmarks.csv", landmarks)
    run(
        "rig", *(output / f"{side}.camera.json" for side in SIDES),
        "--landmarks", output / "survey.csv", "--marks", output / "landmarks.csv", "--pixel-sigma", scene.mark_sigma,
        f"--site={scene.lat},{scene.lon},{scene.height}", "-o", output / "rig.json", "--picture", output / "rig.png",
        # The simulated light goes straight.
        "--refraction=0±0",
    )  # fmt: skip
    lap("rig")

    marks, targets = scene.target_marks, scene.targets
    rooms.write_marks(output / "points.csv", kcal.locate.Marks.of_pair(targets.names, marks.left, marks.right))
    _write_places(output / "truth.csv", targets)
    command = locate_again(output, "--pixel-sigma", scene.mark_sigma, "--truth", output / "truth.csv")
    rig = rooms.load_pair(output / "rig.json")
    localize = kcal.Localizer(rig, pixel_sigma=scene.mark_sigma)
    both = (marks.left, marks.right), (marks.true_left, marks.true_right)
    marked = (kcal.locate.Marks.of_pair(targets.names, *pixels) for pixels in both)
    located, exact = (kcal.locate_points(localize, own) for own in marked)
    lap("positions and maps")
    rows, chance = rooms.truth_rows(located, exact, targets.enu), rooms.chance_text(located, targets.enu)
    out.print("\nTrue against estimated positions")
    print_table(rows)
    out.print(
        f"Marks have {scene.mark_sigma:g} px of noise in each image; the interval includes it and the errors of the "
        "rig. The last column is the error with marks that have no noise: the calibration's share."
    )
    chance += f" {_more_draws(scene, rig)}"
    out.print(chance)
    run("report", output / "rig.json", "--require", REQUIREMENT, "--pixel-sigma", scene.mark_sigma)
    _save_site_summary(output, scene, rows, chance, command)
    times = [f"{name} {end - start:.1f} s" for (_, start), (name, end) in itertools.pairwise(laps.items())]
    out.print(f"Time: {', '.join(times)}, together {laps['positions and maps'] - laps['']:.1f} s.")
    print_results(output, command)


def _more_draws(scene: rooms.DemoScene, rig: kcal.Rig) -> str:
    """How many intervals of this rig contain the true range over many draws of the noise in the marks."""
    draws, targets = 200, scene.points_rig(scene.targets)
    marks = rooms.mark_points(scene.rig, targets.repeat(draws, 1), scene.mark_sigma, scene.generator(-30))
    ranges = targets.norm(dim=-1).repeat(draws)
    share = rooms.interval_coverage(kcal.Localizer(rig, pixel_sigma=scene.mark_sigma), marks.left, marks.right, ranges)
    return f"With {draws} other draws of the noise in the marks, {100 * share:.0f} % of the intervals contain it."


def _write_places(path: Path, points: rooms.NamedPoints, sigma: float | None = None) -> None:
    """Write places as a surveyor hands them over, to a millimeter with a sigma, and exactly without."""
    form, known = ("{!r}", "") if sigma is None else ("{:.3f}", f"{sigma:g}")
    places = zip(points.names, points.enu.tolist(), strict=True)
    rows = ([name, *map(form.format, place), known, ""] for name, place in places)
    write_atomic(path, rooms.places_csv(rooms.LOCAL, rows))
