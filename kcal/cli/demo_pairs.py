"""`kcal demo --images`: the whole chain on a folder of real stereo pairs of a board."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from kcal.cli.console import err, out, print_table
from kcal.cli.demo_steps import SIDES, locate_again, print_results, run
from kcal.errors import FileError

if TYPE_CHECKING:
    from kcal.corners.board import Board
    from kcal.locate.geodesy import Origin
    from kcal.locate.marks import Marks


def real_pairs(
    output: Path, folder: Path, size: str, square: str, board: Board, origin: Origin | None, heading: float
) -> None:
    """Calibrate from a folder of pairs, and locate two opposite corners of each board, whose distance is known."""
    from kcal.cli.demo_summary import save_pairs_summary
    from kcal.io.rig_file import load_rig
    from kcal.lens.mounting import Origin
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
