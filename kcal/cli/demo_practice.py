"""`kcal demo --practice`: a rendered site to mark, calibrate, solve and follow on, with its truth kept aside."""

from __future__ import annotations

import functools
import importlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kcal.cli.console import err, out, steps
from kcal.errors import FileError
from kcal.files import dump_json, make_folder, read_bytes, write_atomic
from kcal.strict_json import MOST_BYTES, read_json

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from kcal.sim.practice import PracticeSite, Side

# Hidden, so that it is not read by accident.
TRUTH = Path(".truth") / "truth.json"
# A board's picture takes as long as so many frames of the film, a picture of the site as so many.
_BOARD_STEPS, _PICTURE_STEPS = 15, 100
_DETECTION_SIGMA = 0.2  # px
# What parts of a site need beyond kcal itself, and the extra that brings it along.
_EXTRAS = {"av": "video", "erfa": "stars"}

_DETECTOR = '''"""A detector for `kcal live`: what differs from the picture of the site without ships.

With your own cameras take a detector that knows ships: any callable from an image to boxes will do.
"""

from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

HERE = Path(__file__).parent
EMPTY = [np.asarray(Image.open(HERE / "site" / f"{side}.png").convert("L"), np.float32) for side in ("left", "right")]


def find_ships(image):
    """Boxes (N, 4) x1, y1, x2, y2 in pixels of what is not there on a day without ships."""
    gray = image[..., 0].astype(np.float32)
    change = min((gray - empty for empty in EMPTY), key=lambda change: np.abs(change[::16, ::16]).mean())
    height, width = (size // 2 for size in change.shape)
    blocks = change[: 2 * height, : 2 * width].reshape(height, 2, width, 2).mean((1, 3))
    moved = np.abs(ndimage.uniform_filter(blocks, 2)) > 3.5
    # Parts of a ship that look like what is behind it do not part it.
    labels, _ = ndimage.label(ndimage.binary_dilation(moved, np.ones((3, 9))))
    labels[~moved] = 0
    boxes = [(2 * x.start, 2 * y.start, 2 * x.stop, 2 * y.stop) for y, x in ndimage.find_objects(labels)]
    return np.array([box for box in boxes if box[2] - box[0] > 7 and box[3] - box[1] > 5], float).reshape(-1, 4)
'''


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
    from kcal.sim.practice import PracticeSite, practice_scene

    scene = practice_scene(seed, views, scale)
    site = PracticeSite(scene)
    parts = list(_practice_parts(site, frames))
    missing = [(path, work, write) for path, work, write in parts if not (folder / path).exists()]
    done = 0
    with steps("rendering", sum(work for _, work, _ in missing) or None) as advance:
        for path, work, write in missing:
            make_folder((folder / path).parent)
            left = work
            said = f"{path}"

            def step(said: str = said) -> None:
                nonlocal left
                left -= 1
                advance(said)

            advance(said, 0)
            try:
                write(folder / path, step)
            except ImportError as error:
                extra = _EXTRAS.get(error.name or "", "video")
                cure = f"pip install 'kcal[{extra}]', and run this again"
                err.print(f"{path} needs {error.name}, which is not installed: {cure}", markup=False)
                continue
            done += 1
            advance(said, left)
    kept = len(parts) - len(missing)
    text = f"; {kept} files were there already and are as they were" if kept else ""
    out.print(f"wrote {done} files to {folder}{text}", markup=False)
    out.print(f"Begin with:\n  cd {folder}\n  cat README.txt", markup=False)


def check_folder(folder: Path, seed: int) -> None:
    """Raise `FileError` unless a site of the seed may be written here: nothing, or a part of that very site."""
    if (folder / TRUTH).exists():
        truth = read_truth_file(folder)
        own = truth.get("seed")
        if own != seed:
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


def _practice_parts(site: PracticeSite, frames: int) -> Iterator[tuple[Path, int, _Write]]:
    """Each file with the steps of its bar, and what writes it; the truth first, which says whose folder it is."""
    from kcal.cli.practice_files import night_name, readme_text, survey_text, targets_text
    from kcal.sim.practice import SIDES
    from kcal.sim.practice_truth import practice_truth

    def text(make: Callable[[], str]) -> _Write:
        return lambda path, _: write_atomic(path, make())

    yield TRUTH, 1, text(lambda: dump_json(practice_truth(site, frames)))
    yield Path("README.txt"), 1, text(lambda: readme_text(site.scene))
    yield Path("survey.csv"), 1, text(lambda: survey_text(site.scene))
    yield Path("targets.csv"), 1, text(targets_text)
    yield Path("find_ships.py"), 1, text(lambda: _DETECTOR)
    yield from _board_parts(site)
    for side in SIDES:
        yield Path("site", f"{side}.png"), _PICTURE_STEPS, functools.partial(_picture, site, side)
    yield from ((Path("night", night_name(side)), 1, functools.partial(_night, site, side)) for side in SIDES)
    yield Path("site", "sketch.png"), 1, functools.partial(_sketch, site)
    yield Path("video", "detections.jsonl"), 1, text(lambda: _detections(site, frames))
    for side in SIDES:
        yield Path("video", f"{side}.mp4"), frames, functools.partial(_film, site, side, frames)


def _board_parts(site: PracticeSite) -> Iterator[tuple[Path, int, _Write]]:
    from kcal.io.images import write_png
    from kcal.sim.render import render_board
    from kcal.sim.scene import scene_views

    scene = site.scene
    for index, (side, name, pose) in enumerate(scene_views(scene)):

        def write(path: Path, _: Callable[[], None], side: str = side, index: int = index, pose: Any = pose) -> None:
            lens = getattr(scene.rig, side)
            image = render_board(lens, pose, scene.near_board, scene.render, scene.generator(index))
            write_png(path, image.numpy())

        yield Path("boards", side, f"{name.removeprefix('near-')}.png"), _BOARD_STEPS, write


def _picture(site: PracticeSite, side: Side, path: Path, _: Callable[[], None]) -> None:
    from kcal.io.images import write_png

    write_png(path, site.picture(side))


def _night(site: PracticeSite, side: Side, path: Path, _: Callable[[], None]) -> None:
    importlib.import_module("erfa")
    from kcal.cli.practice_files import NIGHT
    from kcal.io.images import write_png
    from kcal.lens.mounting import Origin
    from kcal.sim.practice_night import night_picture
    from kcal.stars.catalog import StarCatalog
    from kcal.stars.night import SkyView

    scene, catalog = site.scene, StarCatalog.bundled()
    view = SkyView(time=NIGHT, origin=Origin(lat=scene.lat, lon=scene.lon, height=scene.height))
    write_png(path, night_picture(site, side, view.directions(catalog), catalog.magnitude))


def _sketch(site: PracticeSite, path: Path, _: Callable[[], None]) -> None:
    from kcal.report.site_sketch import save_site_sketch
    from kcal.sim.practice import LANDMARKS, TARGETS

    scene = site.scene
    groups = [
        ([thing.name for thing in things], site.true_pixels("left", points.enu))
        for things, points in ((LANDMARKS, scene.landmarks), (TARGETS, scene.targets))
    ]
    save_site_sketch(path, site.picture("left", noise=0.0), *groups)


def _film(site: PracticeSite, side: Side, count: int, path: Path, step: Callable[[], None]) -> None:
    from kcal.io.video_file import write_video
    from kcal.sim.practice_film import RATE, frames

    def told() -> Iterator[NDArray[np.uint8]]:
        for frame in frames(site, side, count):
            yield frame
            step()

    write_video(path, told(), RATE)


def _detections(site: PracticeSite, frames: int) -> str:
    """The ships as pairs of marks with noise, one line for each moment, as a detector with a matcher writes them."""
    import numpy as np

    from kcal.sim.practice import PASSAGES, SIDES
    from kcal.sim.practice_film import RATE
    from kcal.sim.practice_truth import ship_boxes

    random = np.random.default_rng([site.scene.seed, 3])
    left, right = (ship_boxes(site, side, frames) for side in SIDES)
    lines = []
    for number in range(frames):
        marks = [
            (pixels[number] + _DETECTION_SIGMA * random.standard_normal((len(PASSAGES), 2))).round(3).tolist()
            for pixels in (left, right)
        ]
        lines.append({"time": number / RATE, "left": marks[0], "right": marks[1], "sigma": _DETECTION_SIGMA})
    return "".join(json.dumps(line) + "\n" for line in lines)
