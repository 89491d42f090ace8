"""`kcal rig`: two cameras and the boards both have seen to a rig file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from kcal.calibrate.stereo import RigCalibrationResult
    from kcal.io.camera_file import CameraFile
    from kcal.io.rig_file import RigFile


def rig(
    left: Annotated[Path, typer.Argument(help="Camera file of the left camera.")],
    right: Annotated[Path, typer.Argument(help="Camera file of the right camera.")],
    pairs: Annotated[
        tuple[Path, Path],
        typer.Option("--pairs", metavar="LEFT.obs.json RIGHT.obs.json", help="Observations of boards seen by both."),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Rig file to write.")],
    match: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="Which views belong together: columns left,right. By name if not given."),
    ] = None,
    refine_cameras: Annotated[
        bool, typer.Option("--refine-cameras", help="Solve for both cameras' intrinsics and lenses again, jointly.")
    ] = False,
    board_warp: Annotated[bool, typer.Option("--board-warp", help="Also estimate how the board bends.")] = False,
) -> None:
    """Solve a stereo rig: where the right camera stands from the left.

    Views are paired by name (left01.jpg with right01.jpg) or by a CSV. A pair whose board was read from the other end
    is turned and listed; a pair that contradicts the others is left out and listed.

    The board's accuracy limits long ranges: watch the σ of the yaw. With a baseline of 10 m, 0.01° of yaw is 436 m at
    5 km.

    **Examples**

    `kcal rig left.camera.json right.camera.json --pairs left.obs.json right.obs.json -o rig.json`

    `kcal rig left.camera.json right.camera.json --pairs l.obs.json r.obs.json --match pairs.csv -o rig.json`
    """
    from kcal.cli.console import err, out, steps
    from kcal.files import check_writable

    check_writable(output, left, right, *pairs, *([match] if match else []))

    import math

    from kcal.calibrate.pairs import pair_by_name, read_pairs
    from kcal.calibrate.stereo import RigOptions, calibrate_rig
    from kcal.corners.observations import Observations
    from kcal.io.camera_file import CameraFile
    from kcal.locate.check import triangulated_sides

    cameras = CameraFile.load(left), CameraFile.load(right)
    seen = Observations.load(pairs[0]), Observations.load(pairs[1])
    names = seen[0].names, seen[1].names
    matched = read_pairs(match, *names) if match is not None else pair_by_name(*names)
    with steps("solving the rig", 1) as advance:
        result = calibrate_rig(
            cameras[0].camera(),
            cameras[1].camera(),
            seen[0],
            seen[1],
            matched,
            RigOptions(refine_cameras=refine_cameras, board_warp=board_warp),
        )
        advance("done")
    rig_record(result, None if refine_cameras else cameras).save(output)

    alone = len(names[0]) + len(names[1]) - 2 * len(matched)
    out.print(f"{len(result.pairs)} of {len(matched)} pairs used, {alone} views without partner")
    out.print(
        f"RMS [bold]{result.rms:.4f} px[/] (left {result.rms_left:.4f}, right {result.rms_right:.4f}); "
        f"{result.status.message}"
    )
    pitch, yaw, roll = (math.degrees(value) for value in result.sigma_rotation.tolist())
    out.print(
        f"baseline [bold]{float(result.rig.baseline):.6f} m[/] ± {_along(result):.6f}; "
        f"σ of yaw {yaw:.5f}°, pitch {pitch:.5f}°, roll {roll:.5f}°"
        + ("" if refine_cameras else " with both cameras taken as exact")
    )
    side, spread = triangulated_sides(result.rig, seen[0].board.columns, seen[0].board.rows, result.pixels)
    true = seen[0].board.square
    out.print(f"triangulated squares: {1e3 * side:.4f} mm ± {1e3 * spread:.4f} mm, the board's are {1e3 * true:.4f} mm")
    for pair in result.flipped:
        out.print(f"turned by 180°: {pair[0]}, {pair[1]} (the board was read from its other end)", markup=False)
    for pair, reason in result.excluded:
        err.print("[yellow]left out:[/]", f"{pair[0]}, {pair[1]}: {reason}")
    for text in result.warnings:
        err.print("[yellow]warning:[/]", text)
    out.print(f"wrote {output}", markup=False)


def rig_record(result: RigCalibrationResult, cameras: tuple[CameraFile, CameraFile] | None) -> RigFile:
    """The rig file of a result; `cameras` are kept whole where they were not solved again."""
    from kcal.io.camera_file import Exclusion, provenance
    from kcal.io.rig_file import RigCalibration, rig_to_file

    return rig_to_file(
        result.rig,
        left=cameras[0] if cameras else None,
        right=cameras[1] if cameras else None,
        calibration=RigCalibration(
            rms=result.rms,
            rms_left=result.rms_left,
            rms_right=result.rms_right,
            pairs=len(result.pairs),
            per_pair_rms={
                _name(pair): rms for pair, rms in zip(result.pairs, result.per_pair_rms.tolist(), strict=True)
            },
            flipped=tuple(_name(pair) for pair in result.flipped),
            excluded=tuple(Exclusion(name=_name(pair), reason=reason) for pair, reason in result.excluded),
            baseline_m=float(result.rig.baseline),
            **provenance(),
        ),
    )


def _name(pair: tuple[str, str]) -> str:
    return f"{pair[0]} {pair[1]}"


def _along(result: RigCalibrationResult) -> float:
    """σ of the baseline's length, metres, from the σ of the translation along it."""
    direction = result.rig.right_from_left_translation / result.rig.baseline
    return float(((direction * result.sigma_translation) ** 2).sum().sqrt())
