"""`kcal calibrate`: an observations file to a camera file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.table import Table

    from kcal.calibrate.camera.calibrate import CameraCalibrationResult
    from kcal.corners.observations import Observations
    from kcal.io.camera_file import CameraFile
    from kcal.lens.calibration import Exclusion


def calibrate(
    observations: Annotated[Path, typer.Argument(help="Observations file from `kcal detect`.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Camera file to write.")],
    model: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Lens model: pinhole, opencv4, opencv5, opencv8, opencv12, opencv14, ext16 ... ext24, or hybrid.",
        ),
    ] = "opencv5",
    board_warp: Annotated[bool, typer.Option("--board-warp", help="Also estimate how the board bends.")] = False,
    focal: Annotated[
        float | None, typer.Option(help="Roughly known focal length in pixels (EXIF, field of view), as a start.")
    ] = None,
    fov: Annotated[
        float | None, typer.Option(help="Roughly known horizontal field of view in degrees, as a start.")
    ] = None,
    fix: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME[=VALUE]", help="Hold a parameter; without a value cx, cy in the middle, else 0."),
    ] = None,
    tie: Annotated[list[str] | None, typer.Option(metavar="NAME=NAME", help="Keep parameters equal, as fx=fy.")] = None,
    free: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Estimate what is held otherwise: skew.")
    ] = None,
    prior: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE±SIGMA", help="Gaussian knowledge of a parameter; +- will do for ±."),
    ] = None,
    weak_prior: Annotated[
        float | None,
        typer.Option(metavar="SHARE", help="Expect a rich lens this close to a pinhole: 0.3 keeps it tame, and fast."),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(help="A known camera: only the board's poses are found, and what --free names."),
    ] = None,
    loss: Annotated[
        str | None,
        typer.Option(metavar="KIND", help="Robust loss against wrong corners: huber, cauchy or tukey."),
    ] = None,
    loss_scale: Annotated[float, typer.Option(help="Where the robust loss sets in, pixels.")] = 1.0,
    reject: Annotated[
        bool, typer.Option("--reject", help="Leave out corners and views that noise cannot explain, and list them.")
    ] = False,
    reject_limit: Annotated[
        float, typer.Option(help="Greatest share of the corners that --reject may leave out.")
    ] = 0.1,
    name: Annotated[str, typer.Option(help="Name of the camera; the observations' file name if not given.")] = "",
    groups: Annotated[
        str,
        typer.Option(metavar="KIND", help="For a hybrid, what is held out together: blocks of views, or views."),
    ] = "blocks",
    picture: Annotated[Path | None, typer.Option(help="A .png file: coverage, residuals and views.")] = None,
) -> None:
    """Calibrate one camera: intrinsics, lens and error bars.

    Minimizes the reprojection error of all corners over all parameters. Rich lens models are reached through the
    models nested in them, so that more coefficients never end with a larger RMS. A small RMS is not yet accuracy:
    look at the σ of the parameters, and prefer the smaller model, or a weak prior, where they are large.

    **Examples**

    `kcal calibrate left.obs.json -o left.camera.json`

    `kcal calibrate left.obs.json -o left.camera.json --model opencv14 --board-warp --picture left.png`

    `kcal calibrate left.obs.json -o left.camera.json --model opencv14 --weak-prior 0.3`

    `kcal calibrate left.obs.json -o left.camera.json --model hybrid --board-warp`: a plain lens corrected by a smooth
    field, kept only where it predicts views that were held out better than every parametric model.
    """
    from kcal.cli.console import err, out, steps
    from kcal.errors import InputError
    from kcal.files import check_writable
    from kcal.lens.model import LensModel

    check_writable(output, observations)
    if picture is not None:
        from kcal.report.figures import check_picture_format

        check_picture_format(picture)
        check_writable(picture)
    if model == "hybrid":
        from kcal.cli.calibrate_hybrid import calibrate_hybrid_file

        for option, given in (
            ("--fix", fix), ("--tie", tie), ("--free", free), ("--prior", prior), ("--loss", loss),
            ("--reject", reject), ("--weak-prior", weak_prior is not None), ("--camera", camera),
        ):  # fmt: skip
            if given:
                raise InputError(f"{option} does not go with --model hybrid")
        calibrate_hybrid_file(
            observations, output, name, picture, board_warp=board_warp, focal=focal, fov=fov, groups=groups
        )
        return
    lens = LensModel.named(model)
    known = None
    if camera is not None:
        from kcal.io.camera_file import load_camera

        known = load_camera(camera)
        lens = known.model

    from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
    from kcal.calibrate.camera.outliers import OutlierRejection
    from kcal.calibrate.search.model_ladder import steps_to
    from kcal.corners.observations import Observations
    from kcal.solve.robust import RobustLoss

    # An unknown kind is refused by the loss itself.
    robust = None if loss is None else RobustLoss(kind=loss, scale=loss_scale)  # type: ignore[arg-type]
    rejection = OutlierRejection(limit=reject_limit) if reject else None
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
        loss=robust,
        reject=rejection,
    )
    seen = Observations.load(observations)
    with steps("calibrating", 1 + max(1, len(steps_to(lens)) - 1)) as advance:
        result = calibrate_camera(seen, options, advance)
    file = record(result, seen, name or observations.name.split(".")[0], observations.name)
    file.save(output)
    if picture is not None:
        from kcal.report.calibration import save_calibration_picture

        save_calibration_picture(picture, seen, result)

    width, height = seen.image_size
    corners = int((result.residuals[..., 0] == result.residuals[..., 0]).sum())
    used = len(seen.views) - len(result.rejected_views)
    out.print(f"{used} views, {corners} corners, {width}x{height} px, model {lens}")
    out.print(f"RMS [bold]{result.rms:.4f} px[/]; {result.status.message} ({result.iterations} steps)")
    out.print(_table(result))
    if result.board_warp is not None:
        x, y = (1e3 * result.board_warp).tolist()
        out.print(f"board warp: {x:+.3f} mm along its rows, {y:+.3f} mm along its columns")
    if reject:
        out.print(f"left out: {100 * result.rejected_share:.2f} % of the corners")
    for entry in _excluded(result):
        out.print(f"  {entry.name}: {entry.reason}", markup=False, highlight=False)
    for text in result.warnings:
        err.print("[yellow]warning:[/]", text, markup=True)
    for path in (output, picture):
        if path is not None:
            out.print(f"wrote {path}", markup=False)


def _number(text: str, option: str) -> float:
    from kcal.errors import InputError

    try:
        return float(text)
    except ValueError:
        raise InputError(f"{option}: {text.strip()!r} is not a number") from None


def _fixed(texts: list[str]) -> dict[str, float | None]:
    """`--fix` NAME or NAME=VALUE."""
    from kcal.errors import InputError

    found: dict[str, float | None] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if name.strip() in found:
            raise InputError(f"--fix {text}: {name.strip()} is fixed twice")
        found[name.strip()] = _number(value, f"--fix {text}") if equals else None
    return found


def _priors(texts: list[str]) -> dict[str, tuple[float, float]]:
    """`--prior` NAME=VALUE±SIGMA."""
    from kcal.errors import InputError

    found: dict[str, tuple[float, float]] = {}
    for text in texts:
        name, equals, rest = text.partition("=")
        mean, sign, sigma = rest.replace("+-", "±").partition("±")
        if not equals or not sign:
            raise InputError(f"--prior {text}: NAME=VALUE±SIGMA is needed, as fx=1600±5")
        if name.strip() in found:
            raise InputError(f"--prior {text}: {name.strip()} has a prior already")
        found[name.strip()] = _number(mean, f"--prior {text}"), _number(sigma, f"--prior {text}")
    return found


def record(result: CameraCalibrationResult, seen: Observations, name: str, source: str) -> CameraFile:
    """The camera file of a result."""
    from kcal.io.camera_file import camera_to_file, provenance
    from kcal.lens.calibration import BoardRecord, CalibrationRecord

    warp = result.board_warp
    return camera_to_file(
        result.camera,
        name=name,
        standard_deviations=result.sigma,
        covariance=result.covariance if bool(result.covariance.isfinite().all()) else None,
        calibration=CalibrationRecord(
            rms=result.rms,
            views=len(seen.views) - len(result.rejected_views),
            points=int((result.residuals[..., 0] == result.residuals[..., 0]).sum()),
            per_view_rms={
                name: rms for name, rms in zip(seen.names, result.per_view_rms.tolist(), strict=True) if rms == rms
            },
            excluded=tuple(_excluded(result)),
            board=BoardRecord(columns=seen.board.columns, rows=seen.board.rows, square=seen.board.square),
            board_warp=None if warp is None else (float(warp[0]), float(warp[1])),
            stop_reason=result.status.message,
            iterations=result.iterations,
            observations=source,
            **provenance(),
        ),
    )


def _excluded(result: CameraCalibrationResult) -> list[Exclusion]:
    """What was left out, views first."""
    from kcal.lens.calibration import Exclusion

    views = [Exclusion(name=view.view, reason=view.reason) for view in result.rejected_views]
    corners = [Exclusion(name=f"{c.view} corner {c.corner}", reason=c.reason) for c in result.rejected_corners]
    return views + corners


def _table(result: CameraCalibrationResult) -> Table:
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("parameter", no_wrap=True)
    table.add_column("value", justify="right", no_wrap=True)
    table.add_column("± σ", justify="right", no_wrap=True)
    values = dict(zip(result.camera.names, result.camera.params.tolist(), strict=True))
    for name, sigma in result.sigma.items():
        digits = 3 if name in ("fx", "fy", "cx", "cy") else 6
        unknown = "fixed" if name in result.fixed else "not determined"
        spread = unknown if sigma is None else f"{sigma:.{digits}f}"
        if name in result.led_by_prior:
            spread += " (by its prior)"
        table.add_row(name, f"{values[name]:.{digits}f}", spread)
    return table
