"""`kcal show` and `kcal view`: what is in a file of kcal or of another program, as text and in three dimensions.

Files of kcal have a summary of what would have to be computed, so that they are shown without loading torch.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, TypeVar

import pydantic

import kcal
import kcal.report.shown as shown
from kcal.cli import inputs, kinds, rooms
from kcal.cli.console import err, out, print_table, print_wrote, tell
from kcal.cli.inputs import pixel_sigma_and_source
from kcal.cli.locate import LocateOptions, counts_text, pair_localizer, refuse_of_pairs
from kcal.cli.options import Kind, Only
from kcal.errors import FileError
from kcal.file_kind import file_kind
from kcal.files import read_bytes
from kcal.native_file import digest
from kcal.strict_json import MOST_BYTES, read_json
from kcal.texts import counted_text

_Summary = TypeVar("_Summary", bound=pydantic.BaseModel)


def show_command(file: Annotated[Path, inputs.SHOWN]) -> None:
    """Print what is in a file: cameras with their error bars and history, rigs, observations.

    **Example**

    `kcal show left.camera.json`

    Args:
        file: Camera, rig or observations of kcal, or a foreign camera file; rig.json:left is one camera.
    """
    path, name = inputs.named_source(str(file))
    if name is not None:
        rig = kcal.load_rig(path) if file_kind(path) == "rig" else None
        if rig is not None and rig.is_pair and name in rig.names:
            camera = shown.derived_rig(rig)[0][rig.names.index(name)]
        else:
            camera = shown.derived_camera(inputs.single_camera(file))
        _print(shown.camera_blocks(*camera))
        return
    if file_kind(file) not in ("camera", "rig", "observations"):
        _show_foreign(file)
        return
    content = read_json(read_bytes(file, MOST_BYTES), str(file))
    out.print(f"{file}: kcal {content['kcal']} file, version {content.get('version')}")
    if content["kcal"] == "observations":
        _print(shown.observations_blocks(kcal.Observations.load(file)))
        return
    of_pair = not content.get("origin") and len(content.get("names") or "12") == 2
    if of_pair and (written := _as_written(content)) is not None:
        cameras, pose = written
        _print(itertools.chain(*itertools.starmap(shown.camera_blocks, cameras)))
        _print(shown.pose_blocks(*pose) if pose else [])
    elif content["kcal"] == "camera":
        _print(shown.camera_blocks(*shown.derived_camera(kcal.load_camera(file))))
    else:
        rig = kcal.load_rig(file)
        _print(shown.rig_blocks(rig))
        if not rig.is_pair:
            tell(cameras=shown.stands(rig)[1])


def _print(blocks: Iterable[str | list[list[str]]]) -> None:
    for block in blocks:
        out.print(block) if isinstance(block, str) else print_table(block)


def _show_foreign(file: Path) -> None:
    if rooms.recognized(file) == "kcal":
        kind = file_kind(file)
        raise FileError(f"{file}: kcal show knows camera, rig and observations files, not {kind} files")
    found = kcal.lens.import_cameras(file)
    out.print(f"{file}: {found.format}, {counted_text(len(found.cameras), 'camera')}")
    for note in found.notes:
        out.print(f"  {note}")
    _print(itertools.chain(*(shown.camera_blocks(*shown.derived_camera(camera)) for camera in found.cameras)))
    if found.is_rig():
        _print(shown.pose_blocks(*shown.derived_rig(found.rig())[1]))


def _as_written(content: dict[str, Any]) -> tuple[list[shown.ShownCamera], shown.ShownRig | None] | None:
    """Blocks of a file with their summaries; None where it has none, or was changed after they were written."""

    def checked(kind: type[_Summary], summary: Any) -> _Summary:
        return kind.model_validate_json(json.dumps(summary), strict=True)

    try:
        rig, blocks, summaries = None, [content], [content["summary"]]
        if content["kcal"] == "rig":
            rig = content, checked(rooms.RigSummary, content["summary"])
            # The rig knows more of its cameras than each of them knew before it was solved.
            blocks, summaries = content["cameras"], content["summary"]["cameras"]
        cameras = [(block, checked(rooms.CameraSummary, known)) for block, known in zip(blocks, summaries, strict=True)]
        own = {key: value for key, value in content.items() if key != "cameras"}
        fresh = (rig is None or rig[1].of == digest(own)) and all(
            known.of == digest(block) and (known.board is None) == (block["calibration"] is None)
            for block, known in cameras
        )
        return (cameras, rig) if fresh else None
    except (KeyError, TypeError, AttributeError, ValueError):
        # No such file was written by kcal: its reader says what is wrong.
        return None


# `kcal view`: cameras, what they saw and what was located, in the 3-D viewer rerun.

# Without a word to those who made the viewer: it counts what is done in it, unless this is set (tried with 0.41).
_QUIET = {"CI": "1"}


def view_command(
    rig: kinds.AnyFile,
    files: Annotated[list[Path], Kind(metavar="FILE"), inputs.VIEWED] | None = None,
    *,
    output: kinds.NewFile,
    open_: bool = False,
    reach: Annotated[kinds.Distance, Kind(metavar="DISTANCE")] | None = None,
    options: Annotated[LocateOptions, Only(("site", "heading", "pixel_sigma"))],
) -> None:
    """Write a scene for the 3-D viewer rerun: cameras with the field of view of their lenses, and what they saw.

    Files may be, in any order: tables of marks, or a detector's lines as for `kcal live --detections`, which are
    located; positions that `kcal locate` or `kcal live` has written as CSV; landmarks; and for each camera, in the
    rig's order, its observations, or an image. Positions have ellipsoids that contain the true ones with 95 %, and a
    column `time` becomes the viewer's timeline.

    The viewer is an extra, `pip install 'kcal[view]'`. kcal sends nothing; `rerun analytics disable` keeps the viewer
    from counting how it is used.

    **Examples**

    `kcal view rig.json points.csv -o scene.rrd --open`

    `kcal view rig.json boxes.jsonl -o tracks.rrd`

    `kcal view left.camera.json left.obs.json -o boards.rrd`

    Args:
        rig: Rig or camera, of kcal or of another program.
        files: What was seen.
        output: Recording to write, .rrd.
        open_: Open it in the viewer, which then sends no statistics.
        reach: How far rays and images are drawn; as far as the farthest thing that is shown if not given.
    """
    solved = _rig_of(rig)
    noise, note = pixel_sigma_and_source(options.pixel_sigma, solved)
    pair = solved.is_pair
    if not pair:
        refuse_of_pairs(options)
    localize = pair_localizer(solved, options, noise)(solved) if pair else kcal.Localizer(solved, pixel_sigma=noise)
    scene = [_thing(file, localize, note) for file in files or ()]
    kcal.report.save_view(output, localize, *scene, reach=reach)
    print_wrote(output)
    if open_:
        viewer = [sys.executable, "-m", "rerun_cli", "--bind", "127.0.0.1", str(output)]
        quiet = subprocess.DEVNULL
        subprocess.Popen(viewer, env=os.environ | _QUIET, stdout=quiet, stderr=quiet, start_new_session=True)


def _rig_of(source: str) -> kcal.Rig:
    """A rig, or one camera alone as a rig of one."""
    if file_kind(source) == "rig":
        return kcal.load_rig(source)
    path, name = inputs.named_source(source)
    if name is None and file_kind(path) != "camera" and (found := kcal.lens.import_cameras(path)).is_rig():
        return found.rig()
    camera = inputs.single_camera(source)
    return kcal.Rig([camera], [name or path.name.split(".")[0]], rooms.torch.eye(3)[None], rooms.torch.zeros(1, 3))


def _thing(file: Path, localize: kcal.Localizer, note: str) -> Any:
    """Image, observations, positions as they were written, marks or a detector's lines as located now, or landmarks."""
    kind = file_kind(file)
    if kind == "image":
        return rooms.view_image(file)
    if kind == "observations":
        return kcal.Observations.load(file)
    locate = rooms.PointLocator(localize)
    lines = kind in ("foreign", "json")
    if not lines and "status" in rooms.header_of(file):
        located = rooms.read_positions(file, locate)
    elif kind == "survey":
        return rooms.read_survey(file, localize.origin, measured=False)
    else:
        names, single = localize.rig.names, localize.weights == "all"
        if lines:
            chunks: Iterable[kcal.locate.Marks] = [rooms.marks_of_lines(file, localize)]
        else:
            single = single or rooms.is_long(file)
            chunks = (marks for marks, _ in rooms.read_mark_chunks(file, names, single=single))
        locate = rooms.PointLocator(localize.weighing_all()) if single else locate
        located = locate.located(rooms.PositionColumns.joined([*map(locate, chunks)]))
        if note:
            err.print(note)
    codes = located.columns.status.tolist()
    counts = {name: codes.count(code) for code, name in rooms.STATUS_NAMES.items() if code in codes}
    out.print(f"{file}: {counts_text(len(codes), counts)}")
    return located
