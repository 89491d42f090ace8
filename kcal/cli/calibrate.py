"""`kcal calibrate`: an observations file to a camera file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kcal.cli.console import out, print_table, print_wrote, steps, warn
from kcal.errors import InputError
from kcal.files import check_writable

if TYPE_CHECKING:
    from kcal.calibrate.camera.result import CameraCalibrationResult


def calibrate_command(
    observations: Annotated[Path, typer.Argument(help="Observations file from `kcal detect`.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Camera file to write.")],
    model: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Lens model: pinhole, opencv4, opencv5, opencv8, opencv12, opencv14, ext16 ... ext24.",
        ),
    ] = "opencv5",
    board_warp: Annotated[bool, typer.Option("--board-warp", help="Also estimate how the board bends.")] = False,
    focal: Annotated[
        float | None,
        typer.Option(metavar="PX", help="Rough focal length to start from, in pixels; estimated if not given."),
    ] = None,
    fov: Annotated[
        float | None,
        typer.Option(metavar="DEG", help="Rough horizontal field of view to start from, instead of --focal."),
    ] = None,
    fix: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[=VALUE]",
            help="Hold a parameter at a value; without one, cx and cy at the image center, all others at 0.",
        ),
    ] = None,
    tie: Annotated[
        list[str] | None, typer.Option(metavar="NAME=NAME", help="Keep parameters equal, for example fx=fy.")
    ] = None,
    free: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Estimate a parameter that is held by default, as skew.")
    ] = None,
    prior: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE±SIGMA", help="Gaussian prior of a parameter; +- may be typed for ±."),
    ] = None,
    weak_prior: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE",
            help="Weak prior that keeps a rich lens model near a pinhole; 0.3 suits most lenses. None by default.",
        ),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(help="Camera file with known parameters; only board poses and what --free names are estimated."),
    ] = None,
    loss: Annotated[
        str | None,
        typer.Option(metavar="KIND", help="Robust loss against wrong corners: huber, cauchy or tukey."),
    ] = None,
    loss_scale: Annotated[float, typer.Option(metavar="PX", help="Residual at which the robust loss sets in.")] = 1.0,
    reject: Annotated[
        bool, typer.Option("--reject", help="Leave out and list corners and views that noise cannot explain.")
    ] = False,
    reject_limit: Annotated[
        float, typer.Option(metavar="SHARE", help="Largest share of all corners that --reject may leave out.")
    ] = 0.1,
    name: Annotated[str, typer.Option(help="Name of the camera; the name of the observations file if not given.")] = "",
    picture: Annotated[
        Path | None, typer.Option(help="PNG file to write: coverage, residuals, and RMS of each view.")
    ] = None,
) -> None:
    """Calibrate one camera: intrinsics, lens and error bars.

    Minimizes the reprojection error of all corners over all parameters. Rich lens models start from the simpler models
    nested in them, so that more coefficients never end with a larger RMS. A small RMS does not prove an accurate
    camera: check σ of the parameters, and use fewer coefficients or a weak prior where they are large.

    **Examples**

    `kcal calibrate left.obs.json -o left.camera.json`

    `kcal calibrate left.obs.json -o left.camera.json --model opencv14 --board-warp --picture left.png`

    `kcal calibrate left.obs.json -o left.camera.json --model opencv14 --weak-prior 0.3`
    """
    from kcal.lens.model import LensModel

    check_writable(output, observations)
    if picture is not None:
        from kcal.report.figures import check_picture

        check_picture(picture)
    name = name or observations.name.split(".")[0]
    lens = LensModel.named(model)
    known = None
    if camera is not None:
        from kcal.io.camera_file import load_camera

        known = load_camera(camera)
        lens = known.model

    from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
    from kcal.calibrate.camera.outliers import OutlierRejection
    from kcal.calibrate.search.model_ladder import nested_models
    from kcal.corners.observations import Observations
    from kcal.solve.robust import RobustLoss

    options = CalibrationOptions(
        model=lens,
        board_warp=board_warp,
        focal=focal,
        field_of_view=fov,
        fixed=_fixed(fix or []),
        tied=tuple(tuple(name.strip() for name in text.split("=")) for text in tie or []),
        free=tuple(free or []),
        priors=_priors(prior or []),
        weak_prior=weak_prior,
        camera=known,
        # An unknown kind is refused by the loss itself.
        loss=None if loss is None else RobustLoss(kind=loss, scale=loss_scale),  # type: ignore[arg-type]
        reject=OutlierRejection(limit=reject_limit) if reject else None,
    )
    seen = Observations.load(observations)
    with steps("calibrating", 1 + max(1, len(nested_models(lens)) - 1)) as advance:
        result = calibrate_camera(seen, options, advance)
    file = result.file(name=name, source=observations.name)
    file.save(output)
    if picture is not None:
        from kcal.report.calibration import save_calibration_picture

        save_calibration_picture(picture, result)

    width, height = seen.image_size
    if (found := file.calibration) is not None:
        out.print(f"{found.views} views, {found.points} corners, {width}x{height} px, model {lens}")
    out.print(f"RMS [bold]{result.rms:.4f} px[/]; {result.status.message} ({result.iterations} steps)")
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
    print_wrote(output, picture)


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
