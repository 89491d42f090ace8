"""What commands are given: files, checked before anything is loaded, and options of several commands."""

from __future__ import annotations

import dataclasses
import itertools
import os
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import kcal
from kcal.cli import rooms
from kcal.cli.console import err, warn
from kcal.errors import FileError, InputError
from kcal.file_kind import WORDS, file_kind
from kcal.files import is_stream

# Cameras from files of kcal or of other programs, as commands name them: FILE, or FILE:CAMERA.


def named_source(source: str) -> tuple[Path, str | None]:
    """Split `rig.json:left` into the file and the camera's name."""
    path, colon, name = source.rpartition(":")
    if colon and not Path(source).exists() and Path(path).exists():
        return Path(path), name
    return Path(source), None


def picked(found: rooms.ImportedCameras, name: str | None, source: str) -> kcal.Camera:
    """The only camera, or the one of that name; of a rig `left` and `right` name the cameras as well.

    Raises:
        InputError: several cameras and no name, or a name that none has.
    """
    if name is None and len(found.cameras) == 1 and not found.unread:
        return found.cameras[0]
    if name is not None and name in found.unread:
        raise InputError(f"{source}: camera {name}: {found.unread[name]}")
    names = list(found.names)
    if name and name.startswith("/"):
        # A topic of a bag: that of the camera, or of its images.
        topic = name.strip("/").replace("/", "_") + "_"
        name = max((one for one in names if topic.startswith(f"{one}_")), key=len, default=name)
    if len(names) == 2 and name in ("left", "right") and name not in names:
        return found.cameras[("left", "right").index(name)]
    if name is None or names.count(name) != 1:
        wrong = f"no camera {name!r}" if name else f"{len(names) + len(found.unread)} cameras"
        names = ["left", "right"] if len(names) == 2 and len(set(names)) == 1 else names
        listed, example = ", ".join(map(repr, names)), f"{source.removesuffix(f':{name}')}:{names[0]}"
        raise InputError(f"{source}: {wrong}; name one of {listed}, for example {example}")
    return found.cameras[names.index(name)]


def cameras_and_rig(path: Path) -> tuple[rooms.ImportedCameras, kcal.Rig | None]:
    """The cameras of a file of any program, and the rig that they are, if they are one."""
    found = kcal.lens.import_cameras(path)
    warn(*found.notes)
    if len(found.cameras) == 1:
        return found, None
    if rooms.recognized(path) == "kcal":
        return found, kcal.load_rig(path)
    return found, found.rig() if found.is_rig() else None


def single_camera(source: str | Path) -> kcal.Camera:
    """The camera that FILE or FILE:CAMERA names, of kcal or of another program.

    Raises:
        InputError: there is no camera of that name, or there are several and none was named.
    """
    path, name = named_source(str(source))
    kind = file_kind(path)
    # Without the readers of other programs' files, which take long to load.
    if kind == "camera" and name is None:
        return kcal.load_camera(path)
    if kind == "rig" and name in (rig := kcal.load_rig(path)).names:
        return rig.each[rig.names.index(name)]
    found = kcal.lens.import_cameras(path)
    warn(*found.notes)
    return picked(found, name, str(source))


# Check what was given before anything is loaded: is each file there, and is it what the command needs there?


@dataclasses.dataclass(frozen=True)
class Wanted:
    """What a file must be: stands in the annotation of a command's parameter, after its `typer.Argument`.

    Args:
        words: what is needed, for the message.
        kinds: of `kcal.file_kind.WORDS`, all that will do.
        make: the command that makes such a file; `{given}` is what was given, `{name}` its name without suffixes.
        instead: such commands for some of the kinds that may be given in its place.
        part: whether `RIG.json:left` will do, one of a file's cameras.
    """

    words: str
    kinds: frozenset[str]
    make: str
    instead: tuple[tuple[str, str], ...] = ()
    part: bool = False

    def cure(self, given: Path, kind: str, marks: Path | None = None) -> str:
        """The command that makes what is needed, from what was given if that is possible; marks name their cameras."""
        text = _STATION if marks and kind == "camera" else dict(self.instead).get(kind, self.make)
        name = given.name.split(".")[0] or "left"
        quoted = {"given": given, "name": given.with_name(name), "marks": marks}
        return text.format(**{key: shlex.quote(str(path)) for key, path in quoted.items()})


_DETECT = "kcal detect {given} --board 9x6 --square 25mm -o {name}.obs.json"
_CALIBRATE = "kcal calibrate {given} -o {name}.camera.json"
_FROM_IMAGES = (("folder", _DETECT), ("image", _DETECT), ("video", _DETECT))
_SOLVE = "kcal rig left.camera.json right.camera.json --landmarks survey.csv --marks marks.csv -o rig.json"

CAMERA = Wanted(
    "a kcal camera file",
    frozenset({"camera"}),
    "kcal calibrate left.obs.json -o left.camera.json",
    (*_FROM_IMAGES, ("observations", _CALIBRATE), ("foreign", "kcal import {given} -o {name}.camera.json"),
     ("json", "kcal import {given} -o {name}.camera.json")),
    part=True,
)  # fmt: skip
# A rig is solved from cameras as they were calibrated, not from those that another solution has refined.
CALIBRATED = dataclasses.replace(CAMERA, part=False)
CALIBRATED_OR_RIG = dataclasses.replace(
    CALIBRATED, words="a kcal camera or rig file", kinds=frozenset({"camera", "rig"})
)
# A camera in a file of any program, or one of a rig.
ANY_CAMERA = dataclasses.replace(
    CAMERA,
    words="a file with a camera",
    kinds=frozenset({"camera", "rig", "bag", "foreign", "json", "unknown", "table"}),
)
RIG = Wanted(
    "a kcal rig file",
    frozenset({"rig"}),
    _SOLVE,
    (("camera", "kcal rig {given} right.camera.json --landmarks survey.csv --marks marks.csv -o rig.json; of one "
      "camera whose pose you know: kcal place {given} --site LAT,LON,HEIGHT --heading DEG±SIGMA --pitch DEG±SIGMA -o "
      "{name}.rig.json"),
     ("observations", "kcal calibrate left.obs.json right.obs.json -o cameras"),
     ("foreign", "kcal import {given} -o rig.json"), ("json", "kcal import {given} -o rig.json")),
)  # fmt: skip
# Where marks are of any number of cameras, `name,camera,u,v`.
_STATION = (
    "kcal station {given} --landmarks survey.csv --marks marks.csv -o {name}.rig.json (several cameras: kcal rig; a "
    "pose that you know: kcal place), then kcal locate {name}.rig.json {marks}, with --height 12±3 or --terrain "
    "dem.tif for positions"
)
CAMERA_OR_RIG = dataclasses.replace(ANY_CAMERA, words="a camera or rig file", kinds=ANY_CAMERA.kinds - {"table"})
OBSERVATIONS = Wanted(
    "a kcal observations file",
    frozenset({"observations"}),
    "kcal detect images/ --board 9x6 --square 25mm -o left.obs.json",
    _FROM_IMAGES,
)
SHOWN = dataclasses.replace(
    ANY_CAMERA, words="a camera, rig or observations file", kinds=ANY_CAMERA.kinds | {"observations"}
)
BOARD = Wanted(
    "a kcal board file",
    frozenset({"board"}),
    "kcal board measure left.obs.json right.obs.json -o plate.board.json",
    (("observations", "kcal board measure {given} -o {name}.board.json"),),
)
_MARK = "kcal mark left.png right.png --landmarks survey.csv -o marks.csv"
MARKS = Wanted("a table of marks (name,left_u,left_v,right_u,right_v)", frozenset({"marks", "table"}), _MARK)
SURVEY = Wanted(
    "a table of places (name,lat,lon,height,sigma), GeoJSON or GPX",
    frozenset({"survey", "table", "geojson", "gpx", "json"}),
    "kcal import places.gpx --survey-sigma 0.02 --geoid -67.3 -o survey.csv",
)
SITES = Wanted(
    "a table of sites (name,lat,lon,height) or a kcal rig file",
    frozenset({"survey", "table", "rig"}),
    "kcal sites --help",
)
TABLE = Wanted("a table (CSV)", frozenset({"table", "marks", "survey"}), _MARK)
IMAGES = Wanted(
    "an image, a folder of images, a video or a bag",
    frozenset({"image", "folder", "video", "bag", "device", "empty", "unknown", "foreign"}),
    "kcal detect images/ --board 9x6 --square 25mm -o left.obs.json",
    (("observations", _CALIBRATE),),
)
VIDEO = dataclasses.replace(
    IMAGES,
    words="a video",
    kinds=frozenset({"video", "bag", "device", "unknown", "foreign"}),
    make="ffmpeg -framerate 10 -pattern_type glob -i 'left/*.png' -crf 18 left.mp4",
)
VIEWED = dataclasses.replace(
    OBSERVATIONS,
    words="marks, detections, positions, landmarks, observations or an image",
    kinds=MARKS.kinds | {"survey", "observations", "image", "foreign", "json"},
)
FOREIGN = Wanted(
    "a file of another program",
    ANY_CAMERA.kinds | {"image", "survey", "marks", "geojson", "gpx"},
    "kcal import left.yaml -o left.camera.json",
    (("observations", _CALIBRATE),),
    part=True,
)

# As it was typed, after `kcal`; set by `kcal.cli.main`.
typed: list[str] = []


class _Given(NamedTuple):
    """One file on the command line."""

    label: str
    text: str
    wanted: Wanted

    @property
    def path(self) -> Path:
        path, name = named_source(self.text)
        return path if name else Path(self.text)

    def fits(self, text: str) -> bool:
        """Whether that file would do here."""
        path, name = named_source(text)
        if name and file_kind(path) != "bag":
            return self.wanted.part
        return file_kind(path) in self.wanted.kinds or _unseen(text)


def given_texts(value: Any) -> list[str]:
    """What was given with an option, once or several times."""
    return [str(one) for one in (value if isinstance(value, list | tuple) else [value]) if one is not None]


def given_files(value: Any) -> list[str]:
    """The files and folders among it."""
    texts = given_texts(value)
    return [path for text in texts for path in (text, text.rpartition(":")[0]) if os.path.exists(path)]


def check_given(files: Sequence[tuple[str, Wanted, Any]]) -> None:
    """Refuse files that are missing, or not what is wanted, before anything is loaded.

    Args:
        files: what each option is called, what it must be, and what was given.
    """
    found = [_Given(label, text, wanted) for label, wanted, given in files for text in _checked_inputs(wanted, given)]
    # Beside a stream no files are allowed at all, which the command says.
    if any(is_stream(one.text) for one in found if not one.label.startswith("-")):
        return
    for one in found:
        if file_kind(one.path) == "missing" and not _unseen(one.text):
            what = "no such file or folder" if one.wanted is IMAGES else "cannot read: No such file or directory"
            raise FileError(f"{one.text}: {what}")
    check_kinds(found)


def check_file(label: str, text: str, wanted: Wanted) -> None:
    """The same for one file, whose option takes other words as well."""
    if file_kind(text) != "missing":
        check_kinds([_Given(label, text, wanted)])


def check_kinds(found: Sequence[_Given]) -> None:
    """Refuse the first file that is not what is wanted, with the command that would be right.

    Raises:
        FileError: it names the file, what it is, what is needed and where, and the command.
    """
    wrong = next((one for one in found if not one.fits(one.text)), None)
    if wrong is None:
        return
    kind = file_kind(wrong.path)
    what = WORDS.get(kind, f"a kcal {kind} file")
    text = f"{wrong.text}: this is {what}; {wrong.wanted.words} is needed here ({wrong.label})"
    other = next((one for one in found if one is not wrong and one.fits(wrong.text) and wrong.fits(one.text)), None)
    if other is not None and typed:
        exchange = {wrong.text: other.text, other.text: wrong.text}
        raise FileError(f"{text}. The files are in each other's place: {typed_with(exchange)}")
    inside = next(_candidates(wrong, kind), None)
    if inside is not None and typed:
        raise FileError(f"{text}. Perhaps: {typed_with({wrong.text: inside})}")

    tables = [one.path for one in found if wrong.wanted is RIG and one.wanted is MARKS and one.fits(one.text)]
    marks = next(filter(rooms.is_long, tables), None)
    raise FileError(f"{text}. To make one: {wrong.wanted.cure(wrong.path, kind, marks)}")


def typed_with(exchange: dict[str, str], *more: str) -> str:
    """The command as it was typed, with other files and with more words: it can be pasted."""
    words = []
    for word in typed:
        option, equals, value = word.partition("=")
        if equals and word.startswith("--"):
            words.append(f"{option}={exchange.get(value, value)}")
        else:
            words.append(exchange.get(word, word))
    return f"kcal {shlex.join([*words, *more])}"


def _candidates(wrong: _Given, kind: str) -> Iterator[str]:
    """What may have been meant: a camera of the rig, or the only such file in the folder."""
    if kind == "rig" and wrong.wanted.part:
        side = "right" if "right" in wrong.label.lower() else "left"
        yield f"{wrong.text}:{side}"
    if kind == "folder":
        try:
            names = sorted(itertools.islice(os.listdir(wrong.path), 1000))
        except OSError:
            names = []
        fitting = [str(wrong.path / name) for name in names if wrong.fits(str(wrong.path / name))]
        if len(fitting) == 1:
            yield fitting[0]


def _checked_inputs(wanted: Wanted, value: Any) -> list[str]:
    """The files that are checked: of a list of images, one that is none is listed by the command and stops nothing."""
    texts = given_texts(value)
    if wanted is not IMAGES or not isinstance(value, list):
        return texts
    kinds = {text: file_kind(named_source(text)[0]) for text in texts}
    fine = [text for text in texts if kinds[text] in wanted.kinds]
    return [text for text in texts if kinds[text] == "missing"] or fine or texts


def _unseen(text: str) -> bool:
    """Whether a text names no file to look into: the standard input, a wildcard or a stream."""
    return text in ("-", "") or is_stream(text) or (any(c in text for c in "*?[") and not os.path.lexists(text))


# The noise of marks: one option of all commands, with the value that the rig's file states by default.


def pixel_sigma_of(given: float | None, rig: kcal.Rig | None = None) -> float:
    """The noise of marks, px: as given, or as the rig's file states, or assumed; the last two are said."""
    sigma, note = pixel_sigma_and_source(given, rig)
    if note:
        err.print(note)
    return sigma


def pixel_sigma_and_source(given: float | None, rig: kcal.Rig | None = None) -> tuple[float, str]:
    """The same, and what there is to say of it."""
    return rooms.noise_of_marks(given, None if rig is None else rig.calibration, "--pixel-sigma")
