"""`kcal show`: what is in a file of kcal or of another program.

Files of kcal have a summary of what would have to be computed, so that they are shown without loading torch.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import pydantic

import kcal
from kcal.cli.console import out, print_table
from kcal.cli.inputs import SHOWN
from kcal.cli.rig import print_stands
from kcal.errors import FileError
from kcal.file_kind import file_kind
from kcal.files import read_bytes
from kcal.native_file import digest
from kcal.report.shown import (
    camera_blocks,
    derived_camera,
    derived_rig,
    observations_blocks,
    pose_blocks,
    stations_blocks,
)
from kcal.strict_json import MOST_BYTES, read_json

if TYPE_CHECKING:
    from kcal.report.shown import ShownCamera, ShownRig

_Summary = TypeVar("_Summary", bound=pydantic.BaseModel)


def show_command(file: Annotated[Path, SHOWN]) -> None:
    """Print what is in a file: cameras with their error bars and history, rigs, observations.

    **Example**

    `kcal show left.camera.json`

    Args:
        file: Camera, rig or observations of kcal, or a foreign camera file.
    """
    if file_kind(file) not in ("camera", "rig", "observations"):
        _show_foreign(file)
        return
    content = read_json(read_bytes(file, MOST_BYTES), str(file))
    out.print(f"{file}: kcal {content['kcal']} file, version {content.get('version')}")
    if content["kcal"] == "observations":
        _print(observations_blocks(kcal.Observations.load(file)))
        return
    if content["kcal"] == "rig" and (content.get("origin") or len(content.get("names") or "12") != 2):
        rig = kcal.load_rig(file)
        _print(itertools.chain(*(camera_blocks(*derived_camera(camera)) for camera in rig.each), [""]))
        print_stands(rig)
        _print(stations_blocks(rig))
        return
    if (written := _as_written(content)) is not None:
        cameras, pose = written
    elif content["kcal"] == "camera":
        cameras, pose = [derived_camera(kcal.load_camera(file))], None
    else:
        cameras, pose = derived_rig(kcal.load_rig(file))
    _print(itertools.chain(*(camera_blocks(*camera) for camera in cameras), pose_blocks(*pose) if pose else []))


def _print(blocks: Iterable[str | list[list[str]]]) -> None:
    for block in blocks:
        out.print(block) if isinstance(block, str) else print_table(block)


def _show_foreign(file: Path) -> None:
    from kcal.io.formats import recognized

    if recognized(file) == "kcal":
        kind = file_kind(file)
        raise FileError(f"{file}: kcal show knows camera, rig and observations files, not {kind} files")
    found = kcal.lens.import_cameras(file)
    out.print(f"{file}: {found.format}, {len(found.cameras)} cameras")
    for note in found.notes:
        out.print(f"  {note}")
    _print(itertools.chain(*(camera_blocks(*derived_camera(camera)) for camera in found.cameras)))
    if found.is_rig():
        _print(pose_blocks(*derived_rig(found.rig())[1]))


def _as_written(content: dict[str, Any]) -> tuple[list[ShownCamera], ShownRig | None] | None:
    """Blocks of a file with their summaries; None where it has none, or was changed after they were written."""
    from kcal.io.file_summary import CameraSummary, RigSummary

    def checked(kind: type[_Summary], summary: Any) -> _Summary:
        return kind.model_validate_json(json.dumps(summary), strict=True)

    try:
        rig, blocks, summaries = None, [content], [content["summary"]]
        if content["kcal"] == "rig":
            rig = content, checked(RigSummary, content["summary"])
            # The rig knows more of its cameras than each of them knew before it was solved.
            blocks, summaries = content["cameras"], content["summary"]["cameras"]
        cameras = [(block, checked(CameraSummary, known)) for block, known in zip(blocks, summaries, strict=True)]
        own = {key: value for key, value in content.items() if key != "cameras"}
        fresh = (rig is None or rig[1].of == digest(own)) and all(
            known.of == digest(block) and (known.board is None) == (block["calibration"] is None)
            for block, known in cameras
        )
        return (cameras, rig) if fresh else None
    except (KeyError, TypeError, AttributeError, ValueError):
        # No such file was written by kcal: its reader says what is wrong.
        return None
