"""`kcal calibrate`: observations to camera files; and `kcal batch`: images of many cameras, in parallel."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

import typer

import kcal
from kcal.cli import console, kinds, rooms
from kcal.cli.board import given_board
from kcal.cli.console import err, out, print_styled, print_table, print_wrote, steps, tell, warn
from kcal.cli.inputs import BOARD, check_file, pixel_sigma_of, single_camera
from kcal.cli.options import Kind, Rare, Several
from kcal.cli.report import NO, judged, told_usable
from kcal.cli.stars import Night, by_night, joined_by_stars
from kcal.errors import DegenerateError, InputError, KcalError
from kcal.files import check_picture, check_writable, make_folder
from kcal.table import Columns, Table
from kcal.texts import measured_text, number_text, percent_text

_T = TypeVar("_T")


# What `kcal calibrate` tells of a calibration: to persons, and to programs.


def told_calibration(
    result: rooms.CameraCalibrationResult, beside: Path, *, reject: bool, verbose: bool
) -> dict[str, Any]:
    """Print what a person reads, and return what programs want to know.

    A long list of what was left out goes to a file beside the camera's.
    """
    assert result.camera.calibration is not None
    record = result.camera.calibration.record
    assert record is not None
    width, height = result.observations.image_size
    out.print(f"{record.views} views, {record.points} corners, {width}x{height} px, model {result.camera.model}")
    out.print(rooms.distances_text(result))
    # Warnings explain the others.
    ended = "converged" if result.status.name == "CONVERGED" else result.status.message
    fitted = f"; noise {result.noise:.4f} px along an axis; {ended} ({result.iterations} steps)"
    print_styled(f"RMS {result.rms:.4f} px{fitted}", r"(?<=^RMS )\S+ px")
    brief = rooms.summarize(result)
    if brief.worst == brief.worst:
        center, border, worst = (number_text(one, digits=2) for one in (brief.center, brief.border, brief.worst))
        out.print(
            f"points at infinity: ± {center} px in the middle of the image, "
            f"{border} px at its border, {worst} px at worst; no board reached {percent_text(brief.unreached)} of it"
        )
    if result.hybrid is not None:
        (cx, cy), (sx, sy) = result.camera.center.tolist(), (result.sigma[name] for name in ("cx", "cy"))
        out.print(f"focal length {brief.focal}; principal point {measured_text(cx, sx)}, {measured_text(cy, sy, 'px')}")
    if brief.pupil is not None and brief.pupil_sigma is not None:
        pupil = measured_text(1e3 * brief.pupil, 1e3 * brief.pupil_sigma, "mm", sign=True)
        out.print(f"entrance pupil: {pupil} at the image's corner")
    if (board := result.measured_board) is not None and bool(board.amplitudes.any()):
        out.print(f"board: {'; '.join(rooms.board_text(board))}")
    if verbose:
        print_table([["parameter", "value", "± σ"], *_parameters(result)])
    if result.board_warp is not None:
        x, y = (1e3 * result.board_warp).tolist()
        out.print(f"board warp: {x:+.3f} mm along its rows, {y:+.3f} mm along its columns")
    if reject:
        out.print(f"left out: {100 * result.rejected_share:.2f} % of the corners")
    lines = [f"{entry.name}: {entry.reason}" for entry in result.excluded]
    console.print_left_out(lines, beside, f"{len(lines)} views and corners were left out")
    warn(*result.warnings)
    for text in result.advice:
        out.print(f"next: {text}")
    return dict(
        rms_px=result.rms,
        noise_px=result.noise,
        views=int(result.per_view_rms.isfinite().sum()),
        corners=int(result.residuals[..., 0].isfinite().sum()),
        model=str(result.camera.model),
        converged=result.status.name,
        sigma_px={"center": brief.center, "border": brief.border, "worst": brief.worst},
        unreached=brief.unreached,
        focal_px=None if brief.focal is None else brief.focal.value.tolist(),
        focal_sigma_px=None if brief.focal is None else brief.focal.sigma.tolist(),
        parameters=dict(zip(result.camera.names, result.camera.params.tolist(), strict=True)),
        sigma=result.sigma,
        advice=result.advice,
    )


def _parameters(result: rooms.CameraCalibrationResult) -> list[list[str]]:
    """Name, value and σ of each parameter."""
    rows = []
    values = dict(zip(result.camera.names, result.camera.params.tolist(), strict=True))
    for name, sigma in result.sigma.items():
        unknown = "fixed" if name in result.fixed else "not determined"
        spread = unknown if sigma is None else number_text(sigma, sigma)
        if name in result.led_by_prior:
            spread += " (by its prior)"
        rows.append([name, number_text(values[name], sigma, digits=6), spread])
    return rows


_USE = "May it be used?"
_Parametric = Annotated[_T, Kind(rare=True, panel="Options of parametric models")]


def calibrate_command(
    obs: list[kinds.Observed] | None = None,
    *,
    output: kinds.Output,
    stars: Several[Annotated[str, Kind(metavar="IMAGES")]] | None = None,
    time: Rare[Annotated[str | None, Kind(metavar="TIME", of="stars")]] = None,
    site: Rare[Annotated[kinds.Site, Kind(of="stars")] | None] = None,
    picture: Path | None = None,
    verbose: Rare[bool] = False,
    board_shape: Annotated[str, Kind(metavar="KIND")] = "printed",
    without: Rare[Annotated[list[str] | None, Kind(metavar="KIND")]] = None,
    one_type: bool = False,
    reject: bool = False,
    reject_limit: Rare[Annotated[float, Kind(metavar="SHARE", of="reject")]] = 0.1,
    temperature: Rare[kinds.Celsius] | None = None,
    setting: kinds.Settings | None = None,
    name: Rare[str] = "",
    model: Annotated[str, Kind(metavar="NAME")] = "hybrid",
    require: Annotated[kinds.Needs | None, Kind(panel=_USE)] = None,
    report: Annotated[Path | None, Kind(panel=_USE)] = None,
    baseline: Rare[Annotated[kinds.Baseline, Kind(panel=_USE)]] = 10.0,
    pixel_sigma: kinds.PixelSigma | None = None,
    focal: Rare[kinds.Pixels] | None = None,
    fov: Rare[kinds.Degrees] | None = None,
    board_warp: _Parametric[bool] = False,
    fix: _Parametric[kinds.Fixed | None] = None,
    tie: _Parametric[Annotated[list[str] | None, Kind(metavar="NAME=NAME")]] = None,
    free: _Parametric[Annotated[list[str] | None, Kind(metavar="NAME")]] = None,
    prior: _Parametric[kinds.Prior | None] = None,
    weak_prior: _Parametric[Annotated[float, Kind(metavar="SHARE", least=0)]] = 0.3,
    camera: _Parametric[kinds.CameraFile] | None = None,
    loss: _Parametric[Annotated[str | None, Kind(metavar="KIND")]] = None,
    loss_scale: _Parametric[Annotated[kinds.Pixels, Kind(of="loss")]] = 1.0,
) -> None:
    """Calibrate a camera, or several: intrinsics, lens and error bars.

    There is no lens model to choose: the views themselves tell how much of each term of the lens, of the entrance
    pupil's movement and of the board's bending and print errors there is. A small RMS does not prove an accurate
    camera; read the uncertainty of points at infinity, in pixels, and what to photograph next.

    With --stars no board is needed: tilt the camera up by 30°. It is then right at infinity, without an entrance pupil.
    With observations as well, boards and stars give one camera; whether they contradict each other is tested.

    Calibrate both cameras of a rig in one call: those that saw one printed board measure its errors together.

    **Examples**

    `kcal calibrate left.obs.json -o left.camera.json`

    `kcal calibrate left.obs.json right.obs.json -o cameras`

    `kcal calibrate left.obs.json -o left.camera.json --require 5km:10% --report left.html`: exit code 3 for a no.

    `kcal calibrate --stars night/ --time name:Z --site 40.762,-113.896,1282 -o left.camera.json`

    `kcal calibrate left.obs.json -o left.camera.json --model opencv14`: for exchange with OpenCV.

    Args:
        obs: Observations file of each camera, from `kcal detect`.
        output: Camera file to write; of several cameras a folder, for a NAME.camera.json of each.
        stars: Night images: the lens at infinity, by stars, alone or with boards.
        time: Of --stars. When, with its zone: 2026-11-24T20:47:26Z; name:Z or name:+02:00 reads it from each file's
            name.
        site: Of --stars, for refraction.
        picture: Picture to write (.png, .svg or .pdf): coverage, where the camera is uncertain, residuals, RMS of each
            view; of several cameras, NAME.png in this folder.
        verbose: Print every parameter with its σ.
        board_shape: printed: bending and print errors are estimated. exact: a metrology plate. Or the file of a board
            that `kcal board measure` wrote.
        without: motion: nothing moves while rows are read. bending: the board is stiff in all views.
        one_type: The cameras, four or more, are of one type: each learns from the others.
        reject: Leave out and list corners and views that noise cannot explain.
        reject_limit: Largest share of all corners that --reject may leave out.
        temperature: Of the camera when the views were taken; kept in its file.
        setting: Where zoom or focus of the lens stood, for `kcal interpolate`; may be repeated. Of several cameras one
            number for all, or focus=1,2.5,4 for each.
        name: Name of the camera; the name of the observations file if not given.
        model: hybrid, which fits any camera; network, the same with a small trained network as its field; or for
            exchange a parametric lens: pinhole, opencv4, opencv5, opencv8, opencv12, opencv14, ext16 ... ext24,
            fisheye4.
        require: What you need: ranges and the largest σ of each, for example 5km:10% or 800m:20m,5km:10%. Exit code 3
            if it is not met.
        report: HTML page to write: may it be used, and why not; of several cameras, NAME.html in this folder.
        baseline: Distance to a second camera like this one.
        focal: Rough focal length to start from, in pixels; estimated if not given.
        fov: Rough horizontal field of view to start from, instead of --focal; a fisheye may have 180 and more.
        board_warp: Estimate how the board bends.
        fix: Hold a parameter at a value; without one, cx and cy at the image center, all others at 0.
        tie: Keep parameters equal, for example fx=fy.
        free: Estimate a parameter that is held by default, as skew.
        prior: Gaussian prior of a parameter; +- may be typed for ±.
        weak_prior: How far a rich lens is expected to be from a pinhole; 0: no such prior, as in OpenCV.
        camera: Camera file with known parameters; only board poses and what --free names are estimated.
        loss: Robust loss against wrong corners: huber, cauchy or tukey.
        loss_scale: Residual at which the robust loss sets in.
    """
    count, settings, night = len(obs or [output]), setting or {}, Night(time=time, site=site)
    for key, numbers in settings.items():
        if len(numbers) not in (1, count):
            raise InputError(f"--setting {key}: {len(numbers)} numbers for {count} cameras; give one, or one for each")
    if obs is None and settings:
        raise InputError("--setting: cameras of stars alone do not keep it; give observations of a board as well")
    if not obs:
        by_night(stars, night, output, name)
        return
    if stars and len(obs) > 1:
        raise InputError("--stars are of one camera: calibrate each with its own boards and night images")
    needs = require or ()
    if board_shape not in ("printed", "exact"):
        check_file("--board-shape", board_shape, BOARD)
    places = _camera_files(obs, output, picture, report, name)
    if model not in ("hybrid", "network"):
        kcal.lens.LensModel.named(model)
    if unknown := set(without or ()) - {"motion", "bending"}:
        raise InputError(f"--without {unknown.pop()}: write motion or bending")
    options = kcal.CalibrationOptions(
        model=model,
        motion="motion" not in (without or ()),
        bending="bending" not in (without or ()),
        # An unknown kind is refused by the options themselves, and that of a loss by the loss.
        board=kcal.calibrate.load_measured_board(board_shape) if Path(board_shape).suffix else board_shape,  # type: ignore[arg-type]
        board_warp=board_warp,
        focal=focal,
        field_of_view=fov,
        fixed=fix or {},
        tied=tuple(tuple(name.strip() for name in text.split("=")) for text in tie or []),
        free=tuple(free or []),
        priors=prior or {},
        weak_prior=weak_prior or None,
        camera=None if camera is None else single_camera(camera),
        loss=None if loss is None else kcal.solve.RobustLoss(kind=loss, scale=loss_scale),  # type: ignore[arg-type]
        reject=rooms.OutlierRejection(limit=reject_limit) if reject else None,
    )
    sets = [kcal.Observations.load(place.observations) for place in places]

    def cure(error: object, i: int) -> str:
        # Where options name parameters, the views are not to blame.
        named = isinstance(error, InputError) and (fix or tie or prior or free)
        return "" if named else console.views_cure(error, sets[i], places[i].observations)

    with steps("calibrating", None) as advance:
        if len(sets) > 1:
            outcomes = kcal.calibrate.calibrate_cameras(sets, options, advance, one_type=one_type)
        else:
            with console.ending_with(lambda error: cure(error, 0)):
                outcomes = [kcal.calibrate_camera(sets[0], options, advance)]
    if stars and not isinstance(outcomes[0], KcalError):
        outcomes = [joined_by_stars(outcomes[0], stars, night, places[0].output)]
    failed = [place.name for place, result in zip(places, outcomes, strict=True) if isinstance(result, KcalError)]
    usable = True
    in_full = verbose or not options.hybrid
    figures: dict[str, dict[str, Any]] = {}
    noise = None
    for i, (place, result) in enumerate(zip(places, outcomes, strict=True)):
        if len(places) > 1:
            print_styled(place.name, ".*")
        if isinstance(result, KcalError):
            warn(f"{place.name}: {console.with_command(str(result), cure(result, i))}")
            continue
        stood = {key: numbers[i % len(numbers)] for key, numbers in settings.items()}
        stated = kcal.lens.LensSetting(values=stood) if stood else None
        source = place.observations.name
        result.save(place.output, name=place.name, source=source, temperature=temperature, setting=stated)
        if place.picture is not None:
            kcal.report.save_picture(place.picture, kcal.report.calibration_figure(result, place.name))
        figures[place.name] = told_calibration(result, place.output, reject=reject, verbose=in_full)
        if result.shared_board is not None:
            others = ", ".join(places[i].name for i in result.shared_board.others)
            out.print(f"the board is that of {others} (evidence {result.shared_board.evidence:.0f} nats)")
        print_wrote(place.output, place.picture)
        if needs or place.report is not None:
            noise = noise or pixel_sigma_of(pixel_sigma)
            found = judged(result, options, needs, baseline=baseline, mark_sigma=noise, name=place.name)
            figures[place.name]["verdict"] = found.verdict.to_dict()
            usable = told_usable(found, place.report, result.findings) and usable
    tell(cameras=figures)
    if failed:
        raise DegenerateError(f"{len(failed)} of {len(places)} cameras failed: {', '.join(failed)}")
    if not usable:
        raise typer.Exit(NO)


class _CameraFiles(NamedTuple):
    """Where the files of one camera are."""

    observations: Path
    output: Path
    picture: Path | None
    report: Path | None
    name: str


def _camera_files(
    observations: list[Path], output: Path, picture: Path | None, report: Path | None, name: str
) -> list[_CameraFiles]:
    """Files of each camera, all of which can be written."""
    several = len(observations) > 1
    if several and name:
        raise InputError("--name names one camera; several are named after their observations files")
    names = [name or path.name.split(".")[0] for path in observations]
    for twice in names:
        first, *others = [path for path, own in zip(observations, names, strict=True) if own == twice]
        if others:
            copy = others[0].with_name(f"{others[0].parent.name or 'other'}-{others[0].name}")
            raise InputError(
                f"{first} and {others[0]} are both named {twice}: their cameras would overwrite each other. "
                f"To tell them apart: {shlex.join(['mv', str(others[0]), str(copy)])}"
            )
    places = []
    for path, own in zip(observations, names, strict=True):
        files = output, picture, report
        if several:
            for folder in filter(None, files):
                make_folder(folder)
            files = output / f"{own}.camera.json", picture and picture / f"{own}.png", report and report / f"{own}.html"
        place = _CameraFiles(path, *files, own)
        for file in filter(None, (place.output, place.report)):
            check_writable(file, *observations)
        if place.picture is not None:
            check_picture(place.picture)
        places.append(place)
    return places


# `kcal batch`: many cameras at once, in parallel, continued after an interruption.


def batch_command(
    cameras: Path,
    *,
    output: kinds.Output,
    board: kinds.BoardOrAuto = "auto",
    square: kinds.Square | None = None,
    model: Annotated[str, Kind(metavar="NAME")] = "hybrid",
    refine: kinds.RefineMethod = "erf",
    board_warp: bool = False,
    one_type: bool = False,
    workers: Annotated[int, Kind(least=0)] = 0,
    scheduler: Annotated[str | None, Kind(metavar="ADDRESS")] = None,
    time_limit: Annotated[float, Kind(metavar="S", least=1)] = 300.0,
) -> None:
    """Calibrate many cameras: images in, observations, camera files and one table out.

    Writes NAME.obs.json and NAME.camera.json for each camera, and summary.csv. Cameras that saw one printed board
    measure its errors together.

    Finished work is kept in a folder .work: the same command continues an interrupted run, and does only what is new
    when images, options or cameras were added. A camera or an image that fails is listed with its reason and does not
    stop the others; the exit code is then 1. Dask workers should have one thread each (--nthreads 1).

    **Examples**

    `kcal batch cameras/ --board 9x6 --square 25mm -o results`

    `kcal batch cameras.csv -o results --workers 4`

    `kcal batch /shared/cameras --board 9x6 --square 25mm -o /shared/results --scheduler tcp://10.0.0.1:8786`

    Args:
        cameras: A folder with a folder of images for each camera, or a CSV with the columns camera,images and, where
            they differ, board,square,model.
        output: Folder for the results; made if it is missing.
        model: Lens model, see `kcal calibrate`.
        board_warp: Also estimate how each board bends.
        one_type: The cameras, four or more, are of one type: each learns from the others.
        workers: Processes on this machine; one per core if 0.
        scheduler: Dask scheduler whose workers see the same files: tcp://host:8786.
        time_limit: Seconds of CPU time for one image or one calibration.
    """
    given = given_board(board, square)
    if model != "hybrid":
        kcal.lens.LensModel.named(model)
    with steps("looking at the images", None):
        jobs = rooms.read_jobs(cameras, given, model, square)
    for job in jobs:
        if given is None and job.board is not None:
            out.print(f"{job.name}: board {job.board}")
    options = rooms.BatchOptions(refine=refine, board_warp=board_warp, one_type=one_type, time_limit=time_limit)
    try:
        with steps("images and cameras", rooms.pieces(jobs)) as advance:
            report = rooms.calibrate_batch(
                jobs, output, options, workers=workers, scheduler=scheduler, progress=advance
            )
    except KeyboardInterrupt:
        err.print("interrupted; what is finished is kept: run the same command to continue")
        raise typer.Exit(130) from None
    columns: Columns = {
        "camera": "camera", "views": "views", "rms": ("RMS px", "{:.4f}"), "focal": ("focal px", "{:.3f}"),
        "sigma_focal": ("± σ", "{:.3f}"), "cx": ("cx", "{:.3f}"), "cy": ("cy", "{:.3f}"), "model": "model",
        "note": "note",
    }  # fmt: skip
    rows = [
        [row.camera, f"{row.views} of {row.images}", row.rms, row.focal, row.sigma_focal, row.cx, row.cy, row.model,
         f"failed: {row.error}" if row.error else row.warnings]
        for row in report.rows
    ]  # fmt: skip
    print_table(Table(columns, rows).cells, left=(0, 7, 8))
    out.print(f"{report.reused} of {report.total} pieces of work were there already")
    print_wrote(report.summary)
    if failed := [row.camera for row in report.rows if row.error]:
        raise DegenerateError(
            f"{len(failed)} of {len(report.rows)} cameras failed: {', '.join(failed[:5])}; see the table"
        )
