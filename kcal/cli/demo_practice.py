"""`kcal demo --practice` and `--score`: a rendered site to mark, calibrate and solve, and how well that was done."""

from __future__ import annotations

import datetime
import functools
import importlib
import importlib.resources
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import kcal
import kcal.sim.practice as practice
from kcal.cli import rooms
from kcal.cli.console import err, out, print_styled, steps, tell_table, warn
from kcal.errors import FileError
from kcal.files import dump_json, make_folder, read_bytes, write_atomic
from kcal.strict_json import MOST_BYTES, read_json
from kcal.table import Table

# The texts of a practice site: what is where, the surveyor's list, and what is to be located.


class Exercise(NamedTuple):
    """A step of the exercise.

    Attributes:
        name: of the step.
        makes: files of which one must be there when it is done.
        commands: what to paste, in the folder of the site.
        leads_on: whether its files serve the next step alone, so that they may have other names.
    """

    name: str
    makes: tuple[str, ...]
    commands: tuple[str, ...]
    leads_on: bool = False


STEPS = (
    Exercise("find the board", ("left.obs.json", "right.obs.json"), tuple(
        f"kcal detect boards/{side} --board 9x6 --square 60mm -o {side}.obs.json" for side in ("left", "right")), True),
    Exercise("calibrate", ("left.camera.json", "right.camera.json"), tuple(
        f"kcal calibrate {side}.obs.json -o {side}.camera.json" for side in ("left", "right"))),
    Exercise("mark", ("marks.csv",), (
        "kcal mark site/left.png site/right.png --cameras left.camera.json right.camera.json --landmarks survey.csv "
        "--targets targets.csv -o marks.csv",), True),
    Exercise("solve the rig", ("rig.json",), (
        "kcal rig left.camera.json right.camera.json --landmarks survey.csv --marks marks.csv -o rig.json",)),
    Exercise("locate", ("positions.geojson",), (
        "kcal locate rig.json marks.points.csv -o positions.geojson --map map.html",)),
    Exercise("follow", ("tracks.csv",), (
        "kcal live rig.json video/left.mp4 video/right.mp4 --detector find_ships:find_ships -o tracks.csv",)),
)  # fmt: skip


# When the night's pictures were taken.
NIGHT = datetime.datetime(2026, 11, 24, 20, 47, 26, tzinfo=datetime.UTC)


def night_name(side: str) -> str:
    """Name of a night's picture, which says when it was taken, in UTC."""
    return f"{side}-{NIGHT:%Y-%m-%dT%H%M%S}.png"


def readme_text(scene: rooms.DemoScene) -> str:
    """What is in the folder, and the commands."""
    commands = "\n".join(
        f"{number}. {step.name}\n" + "\n".join(f"   {command}" for command in step.commands)
        for number, step in enumerate(STEPS, 1)
    )
    place = f"--site {scene.lat:g},{scene.lon:g},{scene.height:g}"
    return _template("README.txt").format(commands=commands, night=night_name("left"), place=place)


def _template(name: str) -> str:
    """A text of the folder `practice` beside this module."""
    return importlib.resources.files("kcal.cli").joinpath("practice", name).read_text(encoding="utf-8")


def survey_text(scene: rooms.DemoScene) -> str:
    """The landmarks as a surveyor hands them over: latitude, longitude, ellipsoidal height, sigma in meters."""
    origin, surveyed = kcal.Origin(lat=scene.lat, lon=scene.lon, height=scene.height), scene.surveyed(scene.landmarks)
    places = zip(surveyed.names, kcal.locate.enu_to_geodetic(surveyed.enu, origin).tolist(), strict=True)
    lines = [f"{name},{lat:.9f},{lon:.9f},{height:.3f},{scene.survey_sigma:g}\n" for name, (lat, lon, height) in places]
    return "".join(["name,lat,lon,height,sigma\n", *lines])


def targets_text() -> str:
    """Names of what is to be located, and which point is meant."""
    return "".join(["name,mark\n", *(f"{thing.name},{thing.where}\n" for thing in practice.TARGETS)])


# `kcal demo --practice`: a rendered site to mark, calibrate, solve and follow on, with its truth kept aside.

# Hidden, so that it is not read by accident.
TRUTH = Path(".truth") / "truth.json"
# A board's picture takes as long as so many frames of the film, a picture of the site as so many.
_BOARD_STEPS, _PICTURE_STEPS = 15, 100
_DETECTION_SIGMA = 0.2  # px
# What parts of a site need beyond kcal itself, and the extra that brings it along.
_EXTRAS = {"av": "video", "erfa": "stars"}


def practice_site(folder: Path, seed: int, *, views: int = 12, frames: int = 600, scale: float = 1.0) -> None:
    """Render a site into a folder: what is missing of it, so that an interrupted run is continued.

    Args:
        folder: made if it is missing.
        seed: of the site.
        views: of the board by each camera.
        frames: of the film.
        scale: of the images; below 1 for quick tests.

    Raises:
        FileError: the folder has other files, or a site of another seed.
    """
    check_folder(folder, seed)
    site = practice.PracticeSite(practice.practice_scene(seed, views, scale))
    parts = list(_practice_parts(site, frames))
    missing = [(path, work, write) for path, work, write in parts if not (folder / path).exists()]
    done = 0
    with steps("rendering", sum(work for _, work, _ in missing) or None) as advance:
        for path, work, write in missing:
            make_folder((folder / path).parent)
            said = f"{path}"
            advance(said, 0)
            try:
                write(folder / path, functools.partial(advance, said))
            except ImportError as error:
                extra = _EXTRAS.get(error.name or "", "video")
                cure = f"pip install 'kcal[{extra}]', and run this again"
                err.print(f"{path} needs {error.name}, which is not installed: {cure}")
                continue
            done += 1
            # Of a film each frame was told.
            advance(said, 0 if path.suffix == ".mp4" else work)
    kept = len(parts) - len(missing)
    text = f"; {kept} files were there already and are as they were" if kept else ""
    out.print(f"wrote {done} files to {folder}{text}")
    out.print(f"Begin with:\n  cd {folder}\n  cat README.txt")


def check_folder(folder: Path, seed: int) -> None:
    """Raise `FileError` unless a site of the seed may be written here: nothing, or a part of that very site."""
    if (folder / TRUTH).exists():
        if (own := read_truth_file(folder).get("seed")) != seed:
            raise FileError(f"{folder}: here is the site of seed {own}; give --seed {own} or another folder")
    elif folder.is_dir() and any(folder.iterdir()):
        raise FileError(f"{folder}: this folder has other files; name one that is empty or does not exist yet")
    make_folder(folder)


def read_truth_file(folder: Path) -> dict[str, Any]:
    """The truth of a site.

    Raises:
        FileError: there is none.
    """
    path = folder / TRUTH
    if not path.exists():
        raise FileError(f"{folder}: no practice site is here; make one with: kcal demo --practice {folder}")
    content = read_json(read_bytes(path, MOST_BYTES), str(path))
    if not isinstance(content, dict) or content.get("kcal") != "practice truth":
        raise FileError(f"{path}: this is not the truth of a practice site")
    return content


_Write = Callable[[Path, Callable[[], None]], object]


def _practice_parts(site: practice.PracticeSite, frames: int) -> Iterator[tuple[Path, int, _Write]]:
    """Each file with the steps of its bar, and what writes it; the truth first, which says whose folder it is.

    Of a film each frame is a step, which it tells itself.
    """

    def text(make: Callable[[], str]) -> _Write:
        return lambda path, _: write_atomic(path, make())

    def image(make: Callable[..., NDArray[np.uint8]], *given: Any) -> _Write:
        return lambda path, _: rooms.write_png(path, make(*given))

    yield TRUTH, 1, text(lambda: dump_json(practice.practice_truth(site, frames)))
    yield Path("README.txt"), 1, text(lambda: readme_text(site.scene))
    yield Path("survey.csv"), 1, text(lambda: survey_text(site.scene))
    yield Path("targets.csv"), 1, text(targets_text)
    yield Path("find_ships.py"), 1, text(lambda: _template("find_ships.txt"))
    for index, (side, name, pose) in enumerate(rooms.scene_views(site.scene)):
        path = Path("boards", side, f"{name.removeprefix('near-')}.png")
        yield path, _BOARD_STEPS, image(_board, site.scene, index, side, pose)
    yield from ((Path("site", f"{side}.png"), _PICTURE_STEPS, image(site.picture, side)) for side in practice.SIDES)
    yield from ((Path("night", night_name(side)), 1, image(_night, site, side)) for side in practice.SIDES)
    yield Path("site", "sketch.png"), 1, functools.partial(_sketch, site)
    yield Path("video", "detections.jsonl"), 1, text(lambda: _detections(site, frames))
    for side in practice.SIDES:
        yield Path("video", f"{side}.mp4"), frames, functools.partial(_film, site, side, frames)


def _board(scene: rooms.DemoScene, index: int, side: str, pose: Any) -> NDArray[np.uint8]:
    camera, noise = getattr(scene.rig, side), scene.generator(index)
    return rooms.render_board(camera, pose, scene.near_board, scene.render, noise).numpy()


def _night(site: practice.PracticeSite, side: practice.Side) -> NDArray[np.uint8]:
    importlib.import_module("erfa")
    scene, catalog = site.scene, kcal.stars.StarCatalog.bundled()
    view = kcal.stars.SkyView(time=NIGHT, origin=kcal.Origin(lat=scene.lat, lon=scene.lon, height=scene.height))
    return practice.night_picture(site, side, view.directions(catalog), catalog.magnitude)


def _sketch(site: practice.PracticeSite, path: Path, _: Callable[[], None]) -> None:
    scene = site.scene
    both = (practice.LANDMARKS, scene.landmarks), (practice.TARGETS, scene.targets)
    groups = [([thing.name for thing in things], site.true_pixels("left", points.enu)) for things, points in both]
    rooms.save_site_sketch(path, site.picture("left", noise=0.0), *groups)


def _film(site: practice.PracticeSite, side: practice.Side, count: int, path: Path, step: Callable[[], None]) -> None:
    def told() -> Iterator[NDArray[np.uint8]]:
        for frame in practice.frames(site, side, count):
            yield frame
            step()

    rooms.write_video(path, told(), practice.RATE)


def _detections(site: practice.PracticeSite, frames: int) -> str:
    """The ships as pairs of marks with noise, one line for each moment, as a detector with a matcher writes them."""
    random = np.random.default_rng([site.scene.seed, 3])
    pixels = np.stack([practice.ship_boxes(site, side, frames) for side in practice.SIDES], 1)
    marks = (pixels + _DETECTION_SIGMA * random.standard_normal(pixels.shape)).round(3).tolist()
    lines = [
        {"time": number / practice.RATE, "left": left, "right": right, "sigma": _DETECTION_SIGMA}
        for number, (left, right) in enumerate(marks)
    ]
    return "".join(json.dumps(line) + "\n" for line in lines)


# `kcal demo --score`: how well somebody did on a practice site, in meters, and what comes next.

# Names under which results are looked for, the first that is there.
POSITIONS = ("positions.geojson", "positions.csv")
TRACKS = ("tracks.csv", "tracks.geojsonl")


def practice_score(folder: Path) -> None:
    """Compare what is in a folder with its truth, step by step.

    Raises:
        FileError: no site is there, or a result that cannot be read.
    """
    truth = read_truth_file(folder)
    paths = {str(side): folder / f"{side}.camera.json" for side in practice.SIDES}
    cameras = {side: kcal.load_camera(path) for side, path in paths.items() if path.exists()}
    _show("cameras", "Cameras: error over the image after the best-fit rotation", rooms.score_cameras(cameras, truth))
    rig = rooms.load_pair(folder / "rig.json") if (folder / "rig.json").exists() else None
    what = "Rig: error of ranges over the image, with marks that have no noise"
    _show("ranges", what, None if rig is None else rooms.score_rig(rig, truth))
    if rig is not None:
        true, own = truth["baseline_m"], float(rig.baseline)
        out.print(f"baseline {own:.4f} m, {1e3 * (own - true):+.1f} mm off")
        _score_located(_first(folder, POSITIONS), _first(folder, TRACKS), truth)
    step = next_step(folder)
    if step is None:
        out.print("All steps are done.")
        return
    out.print("\n  ".join([f"next: {step.name}, in {folder}:", *step.commands]))


def next_step(folder: Path) -> Exercise | None:
    """The first step whose files are not all there; what only leads to a step that is done counts as done."""
    others = {"positions.geojson": POSITIONS, "tracks.csv": TRACKS}
    done = [all(_first(folder, others.get(made, (made,))) for made in step.makes) for step in STEPS]
    for step, own, later in zip(STEPS, done, [*done[1:], False], strict=True):
        if not own and not (step.leads_on and later):
            return step
    return None


def _show(name: str, what: str, table: Table | None) -> None:
    print_styled(f"\n{what}", ".+")
    if table is None or not table.rows:
        out.print("not done yet")
    else:
        tell_table(name, table)


def _score_located(positions: Path | None, tracks: Path | None, truth: dict[str, Any]) -> None:
    scores = None if positions is None else rooms.score_positions(positions, truth)
    _show("positions", "Positions: against the truth", scores)
    if scores is not None:
        known = {str(row["target"]).casefold(): row["contains"] for row in scores.records}
        if known:
            inside = sum(row["contains"] for row in scores.records)
            out.print(f"{inside} of {len(scores.rows)} intervals contain the true range; 95 % are to be expected")
        if missing := [name for name in truth["targets"] if name.casefold() not in known]:
            out.print(f"not among the positions: {', '.join(missing)} (names as in targets.csv)")
    found, strays = (None, 0) if tracks is None else rooms.score_tracks(tracks, truth)
    _show("tracks", "Tracks: against the ships", found)
    if strays:
        warn(f"{strays} tracks are near no ship")


def _first(folder: Path, names: tuple[str, ...]) -> Path | None:
    return next((folder / name for name in names if (folder / name).exists()), None)
