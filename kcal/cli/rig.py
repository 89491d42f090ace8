"""`kcal rig`: two cameras and what both have seen to a rig file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer.core import TyperGroup

from kcal.cli.rig_check import check
from kcal.errors import InputError

if TYPE_CHECKING:
    from kcal.calibrate.rig.from_boards import RigCalibrationResult
    from kcal.cli.rig_joint import Sources
    from kcal.io.camera_file import CameraFile
    from kcal.io.rig_file import RigFile


class _RigGroup(TyperGroup):
    """`kcal rig LEFT RIGHT ...` solves a rig; `kcal rig check ...` is a command of its own."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if not args or args[0] not in self.commands:
            args = ["solve", *args]
        return super().parse_args(ctx, args)


app = typer.Typer(cls=_RigGroup, rich_markup_mode="markdown", help="Solve a rig, and check it later.")


def solve(
    left: Annotated[Path, typer.Argument(help="Camera file of the left camera.")],
    right: Annotated[Path, typer.Argument(help="Camera file of the right camera.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Rig file to write.")],
    pairs: Annotated[
        tuple[Path, Path] | None,
        typer.Option("--pairs", metavar="LEFT.obs.json RIGHT.obs.json", help="Observations of boards seen by both."),
    ] = None,
    match: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="Which views belong together: columns left,right. By name if not given."),
    ] = None,
    landmarks: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="Surveyed places: name,lat,lon,height,sigma or name,east,north,up,sigma."),
    ] = None,
    marks: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="Where they are in the images: name,left_u,left_v,right_u,right_v."),
    ] = None,
    features: Annotated[
        Path | None,
        typer.Option(
            metavar="CSV",
            help="Far things matched between the images: left_u,left_v,right_u,right_v and range,range_sigma or "
            "beyond (meters), if known.",
        ),
    ] = None,
    positions: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="Measured camera positions (GNSS): as --landmarks, names left and right."),
    ] = None,
    baseline: Annotated[
        str | None, typer.Option(metavar="M±SIGMA", help="Measured distance between the cameras, e.g. 10.02±0.005.")
    ] = None,
    origin: Annotated[
        str | None,
        typer.Option(metavar="LAT,LON,HEIGHT", help="Of the local frame; the first surveyed place if not given."),
    ] = None,
    mark_sigma: Annotated[float, typer.Option(metavar="PX", help="Noise of marks and matches along each axis.")] = 0.3,
    intrinsics: Annotated[
        Literal["fixed", "prior", "free"],
        typer.Option(help="Cameras as they are, held by their files' sigmas, or free."),
    ] = "fixed",
    keep_all: Annotated[bool, typer.Option("--keep-all", help="Leave nothing out; only warn.")] = False,
    refine_cameras: Annotated[
        bool,
        typer.Option("--refine-cameras", help="Boards only: solve for intrinsics and lenses again, jointly."),
    ] = False,
    board_warp: Annotated[
        bool, typer.Option("--board-warp", help="Boards only: also estimate how the board bends.")
    ] = False,
    reject: Annotated[
        bool, typer.Option("--reject", help="Boards only: leave out pairs that noise cannot explain.")
    ] = False,
    picture: Annotated[
        Path | None, typer.Option(help="A .png file: residuals by source and a plan. Not for boards only.")
    ] = None,
) -> None:
    """Solve a stereo rig: where the right camera stands from the left, and where both stand on the Earth.

    From boards seen by both cameras, surveyed landmarks, far features, a measured baseline and measured camera
    positions: any of them, or all together in one adjustment. What contradicts the rest is left out and named. Boards
    are paired by name (left01.jpg with right01.jpg) or by a CSV; one that was read from its other end is turned.

    The board's accuracy limits long ranges: watch the σ of the yaw. With a baseline of 10 m, 0.01° of yaw is 436 m at
    5 km. Landmarks and far features hold it better than boards do.

    `kcal rig check` looks later whether the cameras still stand as they did.

    **Examples**

    `kcal rig left.camera.json right.camera.json --pairs left.obs.json right.obs.json -o rig.json`

    `kcal rig left.camera.json right.camera.json --landmarks survey.csv --marks marks.csv --features far.csv
    --baseline 10.02±0.005 -o rig.json --picture rig.png`
    """
    from kcal.cli.rig_joint import Sources
    from kcal.files import check_writable
    from kcal.report.figures import check_picture

    sources = Sources(
        pairs=pairs, match=match, landmarks=landmarks, marks=marks, features=features, positions=positions,
        baseline=baseline, origin=origin, mark_sigma=mark_sigma,
    )  # fmt: skip
    check_writable(output, left, right, *sources.files)
    if picture is not None:
        check_picture(picture)
    if sources.only_boards and sources.pairs is None:
        raise typer.BadParameter("give boards (--pairs), landmarks (--landmarks and --marks) or features (--features)")
    if sources.only_boards and sources.pairs is not None and not picture and intrinsics == "fixed":
        _from_boards(
            left, right, sources.pairs, match, output, reject, refine_cameras=refine_cameras, board_warp=board_warp
        )
        return
    if refine_cameras or board_warp or reject:
        raise InputError(
            "--refine-cameras, --board-warp and --reject are for boards only; use --intrinsics prior or free here"
        )
    _from_all(left, right, sources, output, picture, intrinsics, reject=not keep_all)


def _from_all(
    left: Path,
    right: Path,
    sources: Sources,
    output: Path,
    picture: Path | None,
    intrinsics: Literal["fixed", "prior", "free"],
    *,
    reject: bool,
) -> None:
    from kcal.calibrate.rig.solve import JointOptions, solve_rig
    from kcal.cli.console import out, steps
    from kcal.cli.rig_joint import gather, mounting, record, show
    from kcal.io.camera_file import CameraFile
    from kcal.report.rig import save_rig_picture

    cameras = CameraFile.load(left), CameraFile.load(right)
    data, origin = gather(cameras, sources, prior=intrinsics == "prior")
    with steps("solving the rig", 1) as advance:
        solution = solve_rig(data, JointOptions(intrinsics=intrinsics, reject=reject))
        advance("done")
    there = mounting(solution, origin)
    record(solution, cameras, there, fixed=intrinsics == "fixed").save(output)
    if picture is not None:
        save_rig_picture(picture, solution)
    show(solution, there)
    for path in (output, *([picture] if picture else [])):
        out.print(f"wrote {path}", markup=False)


def _from_boards(
    left: Path,
    right: Path,
    pairs: tuple[Path, Path],
    match: Path | None,
    output: Path,
    reject: bool,
    *,
    refine_cameras: bool,
    board_warp: bool,
) -> None:
    import math

    from kcal.calibrate.rig.from_boards import RigOptions, calibrate_rig
    from kcal.calibrate.rig.pairs import pair_by_name, read_pairs
    from kcal.cli.console import err, out, steps
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
            RigOptions(refine_cameras=refine_cameras, board_warp=board_warp, reject=reject),
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
    from kcal.io.camera_file import provenance
    from kcal.io.rig_file import rig_to_file
    from kcal.lens.calibration import Exclusion, RigCalibration

    return rig_to_file(
        result.rig,
        left=cameras[0] if cameras else None,
        right=cameras[1] if cameras else None,
        covariance=result.covariance,
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
    """σ of the baseline's length, meters, from the σ of the translation along it."""
    direction = result.rig.right_from_left_translation / result.rig.baseline
    return float(((direction * result.sigma_translation) ** 2).sum().sqrt())


app.command("solve", hidden=True)(solve)
app.command("check")(check)
