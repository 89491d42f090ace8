"""`kcal view`: cameras, what they saw and what was located, in the 3-D viewer rerun."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import kcal
from kcal.cli import inputs, kinds
from kcal.cli.console import err, out, print_wrote
from kcal.cli.inputs import pixel_sigma_and_source
from kcal.cli.locate import LocateOptions, counts_text, pair_localizer, refuse_of_pairs
from kcal.cli.options import Kind, Only
from kcal.file_kind import file_kind

if TYPE_CHECKING:
    from kcal.locate.positions import Located
    from kcal.locate.survey import Survey

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

    Files may be, in any order: tables of marks, which are located; positions that `kcal locate` or `kcal live` has
    written as CSV; landmarks; and for each camera, in the rig's order, its observations, or an image. Positions have
    ellipsoids that contain the true ones with 95 %, and a column `time` becomes the viewer's timeline.

    The viewer is an extra, `pip install 'kcal[view]'`. kcal sends nothing; `rerun analytics disable` keeps the viewer
    from counting how it is used.

    **Examples**

    `kcal view rig.json points.csv -o scene.rrd --open`

    `kcal view left.camera.json left.obs.json -o boards.rrd`

    Args:
        rig: Rig or camera, of kcal or of another program.
        files: What was seen.
        output: Recording to write, .rrd.
        open_: Open it in the viewer, which then sends no statistics.
        reach: How far rays and images are drawn; as far as the farthest thing that is shown if not given.
    """
    from kcal.report.view import view_image

    solved = _rig_of(rig)
    noise, note = pixel_sigma_and_source(options.pixel_sigma, solved)
    pair = len(solved) == 2 and solved.in_first_frame and solved.root is None
    if not pair:
        refuse_of_pairs(options)
    localize = pair_localizer(solved, options, noise)(solved) if pair else kcal.Localizer(solved, pixel_sigma=noise)
    shown: list[Any] = []
    for file in files or []:
        kind = file_kind(file)
        if kind == "image":
            shown.append(view_image(file))
        elif kind == "observations":
            shown.append(kcal.Observations.load(file))
        else:
            shown.append(_of_table(file, localize, note))
    kcal.report.save_view(output, localize, *shown, reach=reach)
    print_wrote(output)
    if open_:
        viewer = [sys.executable, "-m", "rerun_cli", "--bind", "127.0.0.1", str(output)]
        quiet = subprocess.DEVNULL
        subprocess.Popen(viewer, env=os.environ | _QUIET, stdout=quiet, stderr=quiet, start_new_session=True)


def _rig_of(source: str) -> kcal.Rig:
    """A rig, or one camera alone as a rig of one."""
    import torch

    if file_kind(source) == "rig":
        return kcal.load_rig(source)
    path, name = inputs.named_source(source)
    if name is None and file_kind(path) != "camera" and (found := kcal.lens.import_cameras(path)).is_rig():
        return found.rig()
    camera = inputs.single_camera(source)
    return kcal.Rig([camera], [name or path.name.split(".")[0]], torch.eye(3)[None], torch.zeros(1, 3))


def _of_table(file: Path, localize: kcal.Localizer, note: str) -> Located | Survey:
    """Positions as they were written, marks as they are located now, or landmarks."""
    import torch

    from kcal.locate.export import read_positions
    from kcal.locate.marks import is_long, read_mark_chunks
    from kcal.locate.points import PointLocator
    from kcal.locate.positions import STATUS_NAMES
    from kcal.locate.survey import read_survey
    from kcal.locate.tables import PositionColumns, header_of

    locate = PointLocator(localize)
    if "status" in header_of(file):
        located = read_positions(file, locate)
    elif file_kind(file) == "survey":
        return read_survey(file, localize.origin, measured=False)
    else:
        names, single = localize.rig.names, localize.weights == "all" or is_long(file)
        locate = PointLocator(localize.weighing_all()) if single else locate
        parts, feet = zip(*(locate(marks) for marks, _ in read_mark_chunks(file, names, single=single)), strict=True)
        located = locate.located(PositionColumns.joined(parts), torch.cat(feet) if single else None)
        if note:
            err.print(note)
    codes = located.columns.status.tolist()
    counts = {name: codes.count(code) for code, name in STATUS_NAMES.items() if code in codes}
    out.print(f"{file}: {counts_text(len(codes), counts)}")
    return located
