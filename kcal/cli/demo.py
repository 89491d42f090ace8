"""`kcal demo`: the whole chain, on a simulated site or on a folder of real stereo pairs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kcal.cli.demo_tables import print_diagonals, print_results

if TYPE_CHECKING:
    import torch

    from kcal.calibrate.camera.calibrate import CameraCalibrationResult
    from kcal.corners.board import Board
    from kcal.corners.observations import Observations
    from kcal.locate.geodesy import Origin

SIDES = ("left", "right")


def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the results; made if missing.")] = Path(
        "kcal-demo"
    ),
    seed: Annotated[int, typer.Option(help="Of the simulated site: poses, noise and marks.", min=0)] = 0,
    images: Annotated[
        Path | None, typer.Option(help="A folder of real pairs: left01.jpg with right01.jpg, or left/ and right/.")
    ] = None,
    size: Annotated[str, typer.Option("--board", metavar="CxR", help="With --images: inner corners.")] = "9x6",
    square: Annotated[
        str, typer.Option("--square", metavar="LENGTH", help="With --images: side of a square.")
    ] = "25mm",
    origin: Annotated[
        str, typer.Option(metavar="LAT,LON,HEIGHT", help="With --images: where the left camera stands.")
    ] = "0,0,0",
    heading: Annotated[float, typer.Option(metavar="DEG", help="With --images: azimuth of the left camera.")] = 0.0,
) -> None:
    """Run the main job from images to positions, and show what came out against the truth.

    Without images it renders a site: two cameras 10 m apart behind ray-traced lenses, boards with blur and noise,
    twelve surveyed landmarks, and targets from 100 m to 5 km. The pictures go through the same detection, calibration,
    rig and location as anyone's would; the truth is used at the end, for the comparison. `summary.html` says what was
    done and what came out.

    **Examples**

    `kcal demo`

    `kcal demo --images calibration/ --board 9x6 --square 25mm -o results`
    """
    from kcal.errors import FileError

    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"{output}: cannot make this folder: {error.strerror}") from error
    if images is None:
        from kcal.cli.demo_site import simulated

        simulated(output, seed)
    else:
        from kcal.corners.board import Board
        from kcal.locate.geodesy import Origin

        _real(output, images, Board.parse(size, square), Origin.parse(origin), heading)


def _real(output: Path, folder: Path, board: Board, origin: Origin, heading: float) -> None:
    import torch

    from kcal.cli.console import err
    from kcal.io.rig_file import load_rig
    from kcal.locate.export import write_positions
    from kcal.locate.positions import locate_points
    from kcal.report.map_page import save_map
    from kcal.report.positions import save_positions_picture

    seen = {side: detect(_side_images(folder, side), board, output / f"{side}.obs.json") for side in SIDES}
    for side in SIDES:
        calibrate(seen[side], side, output)
    pairs, pixels = _solve_rig(seen["left"], seen["right"], output)

    # Two opposite corners of each board, whose distance is known.
    ends = [0, board.corners - 1]
    marks = pixels[:, :, ends]
    names = [f"{Path(left).stem} {word}" for left, _ in pairs for word in ("first", "last")]
    left, right = marks[:, 0].reshape(-1, 2), marks[:, 1].reshape(-1, 2)
    both = torch.isfinite(left).all(-1) & torch.isfinite(right).all(-1)
    chosen = [name for name, ok in zip(names, both.tolist(), strict=True) if ok]
    write_marks(output / "points.csv", chosen, left[both], right[both])
    located = locate_points(
        load_rig(output / "rig.json"), left[both], right[both], origin=origin, heading_deg=heading, names=chosen
    )
    write_positions(output / "points.geojson", located)
    write_positions(output / "positions.csv", located)
    save_positions_picture(output / "map.png", located)
    save_map(output / "map.html", located)
    print_diagonals(located, board)
    if origin == type(origin)(lat=0.0, lon=0.0, height=0.0):
        err.print("[yellow]note:[/] no --origin was given: positions are placed at latitude 0, longitude 0")
    print_results(
        output,
        f"kcal locate {output}/rig.json {output}/points.csv --origin={origin.lat},{origin.lon},{origin.height:g} "
        f"--heading {heading:g} -o again.geojson",
    )


def _side_images(folder: Path, side: str) -> list[Path]:
    """Images of one camera: the subfolder of that name, or the files whose name begins with it."""
    from kcal.corners.images import expand_images
    from kcal.errors import FileError

    if (folder / side).is_dir():
        return expand_images([str(folder / side)])
    found = [path for path in expand_images([str(folder)]) if path.name.lower().startswith(side)]
    if not found:
        raise FileError(f"{folder}: no folder {side}/ and no image whose name begins with {side!r}")
    return found


def detect(paths: list[Path], board: Board, target: Path) -> Observations:
    """Find a board in images, write what was found, and say what was not."""
    from rich.markup import escape

    from kcal.cli.console import err, out, steps
    from kcal.corners.detect import detect_images

    with steps("detecting", len(paths)) as advance:
        observations = detect_images(paths, board, progress=advance)
    observations.save(target)
    out.print(f"{target.name}: board found in {len(observations.views)} of {len(paths)} images", markup=False)
    for failure in observations.failures:
        err.print(f"  [yellow]failed[/] {escape(failure.name)}: {escape(failure.reason)}")
    return observations


def calibrate(seen: Observations, side: str, output: Path) -> CameraCalibrationResult:
    """Calibrate a camera; its file and its picture go to a folder."""
    from kcal.calibrate.camera.calibrate import calibrate_camera
    from kcal.cli.calibrate import record
    from kcal.cli.console import err, out, steps
    from kcal.report.calibration import save_calibration_picture

    with steps(f"calibrating {side}", 2) as advance:
        result = calibrate_camera(seen, progress=advance)
    record(result, seen, side, f"{side}.obs.json").save(output / f"{side}.camera.json")
    save_calibration_picture(output / f"{side}.png", seen, result)
    fx, sigma = float(result.camera.focal[0]), result.sigma["fx"]
    out.print(f"{side} camera: RMS {result.rms:.4f} px, fx {fx:.2f} ± {sigma:.2f} px, model {result.camera.model}")
    for text in result.warnings:
        err.print(f"  [yellow]warning:[/] {text}")
    return result


def _solve_rig(
    left: Observations, right: Observations, output: Path
) -> tuple[tuple[tuple[str, str], ...], torch.Tensor]:
    """Solve the rig of the two camera files in `output`; returns the pairs used and their corners."""
    from kcal.calibrate.rig.from_boards import calibrate_rig
    from kcal.calibrate.rig.pairs import pair_by_name
    from kcal.calibrate.rig.solve import RigOptions
    from kcal.cli.console import err, out
    from kcal.io.camera_file import load_camera
    from kcal.locate.check import triangulated_sides

    cameras = load_camera(output / "left.camera.json"), load_camera(output / "right.camera.json")
    pairs = pair_by_name(left.names, right.names)
    result = calibrate_rig(*cameras, left, right, pairs, RigOptions(reject=False))
    result.save(output / "rig.json")
    sides = triangulated_sides(result.stereo(), left.board.columns, left.board.rows, result.pixels)
    out.print(
        f"rig: {len(result.pairs)} of {len(pairs)} pairs, RMS {result.rms:.4f} px, baseline "
        f"{float(result.stereo().baseline):.5f} m; squares {1e3 * sides.mean:.3f} ± {1e3 * sides.spread:.3f} mm, "
        f"true {1e3 * left.board.square:g} mm"
    )
    for item in result.left_out:
        err.print("  [yellow]left out:[/]", f"{item.label}: {item.reason}")
    for text in (*(f"turned by 180°: {turned.board}" for turned in result.flipped), *result.warnings):
        err.print(f"  [yellow]warning:[/] {text}")
    assert result.data.boards is not None
    named = zip(pairs, result.data.boards.names, strict=True)
    return tuple(pair for pair, name in named if name in result.pairs), result.pixels


def write_marks(path: Path, names: tuple[str, ...] | list[str], left: torch.Tensor, right: torch.Tensor) -> None:
    """Write marks as `kcal locate` reads them."""
    from kcal.files import write_atomic

    lines = ["name,left_u,left_v,right_u,right_v"]
    for name, a, b in zip(names, left.tolist(), right.tolist(), strict=True):
        lines.append(",".join([name, *(repr(value) for value in (*a, *b))]))
    write_atomic(path, "\n".join(lines) + "\n")
