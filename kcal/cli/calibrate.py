"""`kcal calibrate`: an observations file to a camera file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer
from rich.markup import escape

from kcal.cli.console import out, print_table, print_wrote, steps, warn
from kcal.errors import DegenerateError, InputError, KcalError
from kcal.files import check_writable, make_folder

if TYPE_CHECKING:
    from kcal.calibrate.camera.result import CameraCalibrationResult

_PARAMETRIC = "Options of parametric models"


def calibrate_command(
    observations: Annotated[
        list[Path],
        typer.Argument(metavar="OBS...", help="Observations file of each camera, from `kcal detect`."),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", help="Camera file to write; of several cameras a folder, for a NAME.camera.json of each."
        ),
    ],
    picture: Annotated[
        Path | None,
        typer.Option(
            help="PNG file to write: coverage, where the camera is uncertain, residuals, RMS of each view; of several "
            "cameras, NAME.png in this folder."
        ),
    ] = None,
    verbose: Annotated[bool, typer.Option("--verbose", help="Print every parameter with its σ.")] = False,
    board: Annotated[
        str,
        typer.Option(
            metavar="KIND",
            help="printed: bending and print errors are estimated. exact: a metrology plate. Or the file of a "
            "board that `kcal board measure` wrote.",
        ),
    ] = "printed",
    analog: Annotated[
        bool, typer.Option("--analog", help="Pixels may not be square: an analog camera behind a frame grabber.")
    ] = False,
    one_type: Annotated[
        bool,
        typer.Option("--one-type", help="The cameras, four or more, are of one type: each learns from the others."),
    ] = False,
    reject: Annotated[
        bool, typer.Option("--reject", help="Leave out and list corners and views that noise cannot explain.")
    ] = False,
    reject_limit: Annotated[
        float, typer.Option(metavar="SHARE", help="Largest share of all corners that --reject may leave out.")
    ] = 0.1,
    name: Annotated[str, typer.Option(help="Name of the camera; the name of the observations file if not given.")] = "",
    model: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="hybrid, which fits any camera, or for exchange a parametric lens: pinhole, opencv4, opencv5, "
            "opencv8, opencv12, opencv14, ext16 ... ext24, fisheye4.",
        ),
    ] = "hybrid",
    focal: Annotated[
        float | None,
        typer.Option(metavar="PX", help="Rough focal length to start from, in pixels; estimated if not given."),
    ] = None,
    fov: Annotated[
        float | None,
        typer.Option(metavar="DEG", help="Rough horizontal field of view to start from, instead of --focal."),
    ] = None,
    board_warp: Annotated[
        bool,
        typer.Option("--board-warp", help="Parametric: estimate how the board bends.", rich_help_panel=_PARAMETRIC),
    ] = False,
    fix: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[=VALUE]",
            help="Hold a parameter at a value; without one, cx and cy at the image center, all others at 0.",
            rich_help_panel=_PARAMETRIC,
        ),
    ] = None,
    tie: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=NAME", help="Keep parameters equal, for example fx=fy.", rich_help_panel=_PARAMETRIC
        ),
    ] = None,
    free: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME", help="Estimate a parameter that is held by default, as skew.", rich_help_panel=_PARAMETRIC
        ),
    ] = None,
    prior: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE±SIGMA",
            help="Gaussian prior of a parameter; +- may be typed for ±.",
            rich_help_panel=_PARAMETRIC,
        ),
    ] = None,
    weak_prior: Annotated[
        float,
        typer.Option(
            metavar="SHARE",
            min=0.0,
            help="How far a rich lens is expected to be from a pinhole; 0: no such prior, as in OpenCV.",
            rich_help_panel=_PARAMETRIC,
        ),
    ] = 0.3,
    camera: Annotated[
        Path | None,
        typer.Option(
            help="Camera file with known parameters; only board poses and what --free names are estimated.",
            rich_help_panel=_PARAMETRIC,
        ),
    ] = None,
    loss: Annotated[
        str | None,
        typer.Option(
            metavar="KIND",
            help="Robust loss against wrong corners: huber, cauchy or tukey.",
            rich_help_panel=_PARAMETRIC,
        ),
    ] = None,
    loss_scale: Annotated[
        float,
        typer.Option(metavar="PX", help="Residual at which the robust loss sets in.", rich_help_panel=_PARAMETRIC),
    ] = 1.0,
) -> None:
    """Calibrate a camera, or several: intrinsics, lens and error bars.

    There is no lens model to choose: the views themselves tell how much of each term of the lens, of the entrance
    pupil's movement and of the board's bending and print errors there is. A small RMS does not prove an accurate
    camera; read the uncertainty of far directions, in pixels, and what to photograph next.

    Calibrate both cameras of a rig in one call: those that saw one printed board measure its errors together.

    **Examples**

    `kcal calibrate left.obs.json -o left.camera.json`

    `kcal calibrate left.obs.json right.obs.json -o cameras`

    `kcal calibrate left.obs.json -o left.camera.json --picture left.png --verbose`

    `kcal calibrate left.obs.json -o left.camera.json --model opencv14`: for exchange with OpenCV.
    """
    from kcal.lens.model import LensModel

    places = _camera_files(observations, output, picture, name)
    if model != "hybrid":
        LensModel.named(model)
    known = None
    if camera is not None:
        from kcal.io.camera_file import load_camera

        known = load_camera(camera)

    from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera, calibrate_cameras
    from kcal.calibrate.camera.outliers import OutlierRejection
    from kcal.calibrate.lensfit.measured_board import load_measured_board
    from kcal.corners.observations import Observations
    from kcal.solve.robust import RobustLoss

    options = CalibrationOptions(
        model=model,
        # An unknown kind is refused by the options themselves, and that of a loss by the loss.
        board=load_measured_board(board) if Path(board).suffix else board,  # type: ignore[arg-type]
        analog=analog,
        board_warp=board_warp,
        focal=focal,
        field_of_view=fov,
        fixed=_fixed(fix or []),
        tied=tuple(tuple(name.strip() for name in text.split("=")) for text in tie or []),
        free=tuple(free or []),
        priors=_priors(prior or []),
        weak_prior=weak_prior or None,
        camera=known,
        loss=None if loss is None else RobustLoss(kind=loss, scale=loss_scale),  # type: ignore[arg-type]
        reject=OutlierRejection(limit=reject_limit) if reject else None,
    )
    sets = [Observations.load(place.observations) for place in places]
    with steps("calibrating", None) as advance:
        outcomes = (
            calibrate_cameras(sets, options, advance)
            if len(sets) > 1
            else [calibrate_camera(sets[0], options, advance)]
        )
    failed = [place.name for place, result in zip(places, outcomes, strict=True) if isinstance(result, KcalError)]
    for place, result in zip(places, outcomes, strict=True):
        if len(places) > 1:
            out.print(f"[bold]{escape(place.name)}[/]")
        if isinstance(result, KcalError):
            warn(f"{place.name}: {result}")
            continue
        result.save(place.output, name=place.name, source=place.observations.name)
        if place.picture is not None:
            from kcal.report.calibration import save_calibration_picture

            save_calibration_picture(place.picture, result)
        _print_result(result, reject=reject, verbose=verbose or not options.hybrid)
        if result.shared_board is not None:
            others = ", ".join(places[i].name for i in result.shared_board.others)
            out.print(f"the board is that of {others} (evidence {result.shared_board.evidence:.0f} nats)", markup=False)
        print_wrote(place.output, place.picture)
    if failed:
        raise DegenerateError(f"{len(failed)} of {len(places)} cameras failed: {', '.join(failed)}")


class _CameraFiles(NamedTuple):
    """Where the files of one camera are."""

    observations: Path
    output: Path
    picture: Path | None
    name: str


def _camera_files(observations: list[Path], output: Path, picture: Path | None, name: str) -> list[_CameraFiles]:
    """Files of each camera, all of which can be written."""
    if len(observations) == 1:
        places = [_CameraFiles(observations[0], output, picture, name or observations[0].name.split(".")[0])]
    else:
        if name:
            raise InputError("--name names one camera; several are named after their observations files")
        names = [path.name.split(".")[0] for path in observations]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise InputError(f"two observations files are named {twice}: their cameras would overwrite each other")
        for folder in (output, picture):
            if folder is not None:
                make_folder(folder)
        places = [
            _CameraFiles(path, output / f"{name}.camera.json", picture and picture / f"{name}.png", name)
            for path, name in zip(observations, names, strict=True)
        ]
    for place in places:
        check_writable(place.output, *observations)
        if place.picture is not None:
            from kcal.report.figures import check_picture

            check_picture(place.picture)
    return places


def _print_result(result: CameraCalibrationResult, *, reject: bool, verbose: bool) -> None:
    from kcal.calibrate.camera.summary import summarize

    assert result.camera.calibration is not None
    record = result.camera.calibration.record
    assert record is not None
    width, height = result.observations.image_size
    model = "hybrid" if result.hybrid is not None else str(result.camera.model)
    out.print(f"{record.views} views, {record.points} corners, {width}x{height} px, model {model}")
    fitted = f"; noise {result.noise:.4f} px along an axis; {result.status.message} ({result.iterations} steps)"
    out.print(f"RMS [bold]{result.rms:.4f} px[/]{fitted}")
    brief = summarize(result)
    if brief.worst == brief.worst:
        out.print(
            f"far directions: ± {brief.center:.3f} px in the middle of the image, {brief.border:.3f} px at its border, "
            f"{brief.worst:.3f} px at worst; no board reached {100 * brief.unreached:.0f} % of it"
        )
    if result.hybrid is not None:
        (f, _, cx, cy), (sf, sx, sy) = result.camera.params[:4].tolist(), (result.sigma[n] for n in ("fx", "cx", "cy"))
        out.print(f"focal length {f:.3f} ± {sf:.3f} px; principal point {cx:.2f} ± {sx:.2f}, {cy:.2f} ± {sy:.2f} px")
    if brief.pupil is not None and brief.pupil_sigma is not None:
        out.print(f"entrance pupil: {1e3 * brief.pupil:+.2f} ± {1e3 * brief.pupil_sigma:.2f} mm at the image's corner")
    if (board := result.measured_board) is not None and bool(board.amplitudes.any()):
        (bend, bend_s), (wide, wide_s), (skew, skew_s), (rest, rest_s) = (
            board.bending, board.stretch, board.shear, board.print_error,
        )  # fmt: skip
        out.print(
            f"board: bends by {1e3 * bend:.2f} ± {1e3 * bend_s:.2f} mm; "
            f"stretch {100 * wide:+.3f} ± {100 * wide_s:.3f} %, shear {100 * skew:+.3f} ± {100 * skew_s:.3f} %, "
            f"print {1e3 * rest:.3f} ± {1e3 * rest_s:.3f} mm"
        )
    if verbose:
        print_table([["parameter", "value", "± σ"], *_parameters(result)])
    if result.board_warp is not None:
        x, y = (1e3 * result.board_warp).tolist()
        out.print(f"board warp: {x:+.3f} mm along its rows, {y:+.3f} mm along its columns")
    if reject:
        out.print(f"left out: {100 * result.rejected_share:.2f} % of the corners")
    for entry in result.excluded:
        out.print(f"  {entry.name}: {entry.reason}", markup=False)
    for text in result.warnings:
        warn(text)
    for text in result.advice:
        out.print(f"next: {text}", markup=False)


def _option_number(text: str, option: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{option}: {text.strip()!r} is not a number") from None


def _fixed(texts: list[str]) -> dict[str, float | None]:
    """Parse `--fix` NAME or NAME=VALUE."""
    found: dict[str, float | None] = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        if name in found:
            raise InputError(f"--fix {text}: {name} is fixed twice")
        found[name] = _option_number(value, f"--fix {text}") if equals else None
    return found


def _priors(texts: list[str]) -> dict[str, tuple[float, float]]:
    """Parse `--prior` NAME=VALUE±SIGMA."""
    found: dict[str, tuple[float, float]] = {}
    for text in texts:
        name, equals, rest = (part.strip() for part in text.partition("="))
        mean, sign, sigma = rest.replace("+-", "±").partition("±")
        if not equals or not sign:
            raise InputError(f"--prior {text}: write NAME=VALUE±SIGMA, for example fx=1600±5")
        if name in found:
            raise InputError(f"--prior {text}: {name} has a prior already")
        found[name] = _option_number(mean, f"--prior {text}"), _option_number(sigma, f"--prior {text}")
    return found


def _parameters(result: CameraCalibrationResult) -> list[list[str]]:
    """Name, value and σ of each parameter."""
    rows = []
    values = dict(zip(result.camera.names, result.camera.params.tolist(), strict=True))
    for name, sigma in result.sigma.items():
        digits = 3 if name in ("fx", "fy", "cx", "cy") else 6
        unknown = "fixed" if name in result.fixed else "not determined"
        spread = unknown if sigma is None else f"{sigma:.{digits}f}"
        if name in result.led_by_prior:
            spread += " (by its prior)"
        rows.append([name, f"{values[name]:.{digits}f}", spread])
    return rows
