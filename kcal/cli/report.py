"""`kcal report` and `kcal check`: may this camera or rig be used, and are its error bars true?"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

import kcal
from kcal.cli import kinds, rooms
from kcal.cli.console import err, followed, out, print_answer, print_styled, print_wrote, steps, tell, tell_table, warn
from kcal.cli.inputs import CALIBRATED_OR_RIG, CAMERA_OR_RIG, pixel_sigma_and_source, pixel_sigma_of, single_camera
from kcal.cli.options import Kind, Several
from kcal.cli.rig_sources import cameras_of_files, check_views_of
from kcal.errors import FileError, InputError
from kcal.file_kind import file_kind
from kcal.files import check_writable, open_atomic, read_bytes
from kcal.table import Columns, Table

# The exit code of a no, apart from errors (1) and wrong usage (2).
NO = 3


class Judged(NamedTuple):
    """A verdict, how the pictures of its page are drawn, and its tables."""

    verdict: rooms.Verdict
    pictures: Callable[[], dict[str, bytes]]
    tables: list[list[list[str]]]


def report_command(
    camera_or_rig: Annotated[Path, CAMERA_OR_RIG],
    *,
    observations: Several[kinds.Observed] | None = None,
    require: kinds.Needs | None = None,
    baseline: kinds.Baseline = 10.0,
    pixel_sigma: kinds.PixelSigma | None = None,
    output: kinds.NewFile | None = None,
) -> None:
    """May I use this camera or rig? Yes or no for each range, one reason, and the next picture to take.

    Error bars are right if lens model and board are. With the observations kcal looks for what they do not know:
    cameras from two halves of the views that differ by more than their σ; residuals that are not noise; a bent board;
    an entrance pupil that moves; blur; views without tilt; mirrored boards; pairs that were not taken at the same
    moment. A rig inherits what is found about its cameras. What could not be checked is listed as a doubt.

    The exit code is 3 if the answer is no, 0 if it is yes, 1 if an input cannot be used.

    **Examples**

    `kcal report left.camera.json --observations left.obs.json --require 5km:10% -o report.html`

    `kcal report rig.json --require 800m:2%,5km:10% --pixel-sigma 0.1 -o report.html`

    Args:
        camera_or_rig: Camera or rig file.
        observations: Views that it was calibrated from; for a rig those of left, then of right; for one of more cameras
            those of each, named as it is. Faults of lens model and board can only be found with them.
        require: What you need: ranges and the largest σ of each, for example 5km:10% or 800m:20m,5km:10%.
        baseline: For a camera: distance to a second one like it.
        output: HTML page to write.
    """
    subject, needs = camera_or_rig, require or ()
    given = observations or []
    if file_kind(subject) == "rig":
        found = _of_rig(subject, given, needs, pixel_sigma)
    else:
        found = _of_camera(subject, given, needs, baseline, pixel_sigma_of(pixel_sigma))
    tell(verdict=found.verdict.to_dict())
    if not told_usable(found, output):
        raise typer.Exit(NO)


def told_usable(found: Judged, page: Path | None, warned: Iterable[rooms.Finding] = ()) -> bool:
    """Print a verdict and write its page; returns whether it is a yes.

    Args:
        found: the verdict, and what its page shows.
        page: to write.
        warned: findings of which the command has warned already.
    """
    verdict = found.verdict
    for line in verdict.lines(warned):
        style = {"  met:": "green", "  miss": "red"}.get(line[:6], "bold")
        print_styled(line, r"^(YES|NO\b|  met(?=:)|  missed(?=:))", style)
    if page is not None:
        ranges = [rooms.range_rows(verdict)] if verdict.answers else []
        with steps("drawing", None):
            drawn = found.pictures()
        print_wrote(rooms.save_verdict_page(page, verdict, drawn, [*ranges, *found.tables]))
    return verdict.usable


def warned_of(result: rooms.RigResult) -> list[rooms.Finding]:
    """Findings of which was warned when a rig was solved, and when its cameras were calibrated."""
    known = [camera.calibration.record for camera in result.data.cameras if camera.calibration]
    return [*result.findings, *(finding for record in known if record for finding in record.findings)]


def _of_camera(
    path: Path, observations: list[Path], needs: tuple[kcal.report.Requirement, ...], baseline: float, mark_sigma: float
) -> Judged:
    camera = single_camera(path)
    name = (camera.calibration.name if camera.calibration else "") or path.name.split(".")[0]
    if not observations:
        found = rooms.stored_verdict(camera, needs, baseline=baseline, mark_sigma=mark_sigma, subject=name)
        return Judged(found, dict, rooms.camera_tables(camera))
    if len(observations) > 1:
        raise InputError("a camera has one observations file; give --observations once")
    result, made = calibrated_again(camera, observations[0], f"calibrating {name}")
    return judged(result, made, needs, baseline=baseline, mark_sigma=mark_sigma, name=name, stored=camera)


def judged(
    result: rooms.CameraCalibrationResult,
    options: kcal.CalibrationOptions,
    needs: tuple[kcal.report.Requirement, ...],
    *,
    baseline: float = 10.0,
    mark_sigma: float,
    name: str,
    stored: kcal.Camera | None = None,
) -> Judged:
    """The verdict on a calibration, with the pictures and tables of its page; `stored` as in `camera_verdict`."""
    with steps(f"checking {name}", None) as advance:
        examination = kcal.calibrate.examine(result, options, advance)
    verdict = kcal.report.camera_verdict(
        result, options, needs, baseline=baseline, mark_sigma=mark_sigma, subject=name, examination=examination,
        stored=stored,
    )  # fmt: skip
    tables = rooms.camera_tables(result.camera, result, name)
    return Judged(verdict, lambda: rooms.camera_pictures(result, examination), tables)


def calibrated_again(
    camera: kcal.Camera, observations: Path, what: str
) -> tuple[rooms.CameraCalibrationResult, kcal.CalibrationOptions]:
    """A camera of a file, calibrated once more from its views: files have no residuals and no poses."""
    seen, options = kcal.Observations.load(observations), rooms.stored_options(camera)
    check_views_of([camera], [seen], [observations])
    with steps(what, None) as advance:
        return kcal.calibrate_camera(seen, options, advance), options


def _of_rig(
    path: Path, observations: list[Path], needs: tuple[kcal.report.Requirement, ...], pixel_sigma: float | None
) -> Judged:
    rig = kcal.load_rig(path)
    cameras = rooms.named_cameras(rig)
    if rig.is_pair and rig.names == ("left", "right"):
        if observations and len(observations) != 2:
            raise InputError("a rig needs --observations LEFT RIGHT")
    elif observations:
        cameras = [cameras[number] for number in cameras_of_files(observations, rig.names)]
    if observations:
        seen = [kcal.Observations.load(file) for file in observations]
        check_views_of([camera for _, camera in cameras], seen, observations)
    name = path.name.split(".")[0]
    return judged_rig(rig, observations, needs, mark_sigma=pixel_sigma_of(pixel_sigma, rig), name=name, cameras=cameras)


def judged_rig(
    rig: kcal.Rig, observations: Sequence[Path], needs: tuple[kcal.report.Requirement, ...], *, mark_sigma: float,
    name: str, cameras: Sequence[tuple[str, kcal.Camera]], result: rooms.RigResult | None = None,
) -> Judged:  # fmt: skip
    """The verdict on a rig and, with the observations of `cameras`, each with its name, on these as well.

    Of a rig that was just solved, `result` has its warnings, its pairs of boards, and what is drawn of it.
    """
    found = []
    for file, (side, camera) in zip(followed("cameras", observations, lambda _: ""), cameras, strict=False):
        again, made = calibrated_again(camera, file, f"calibrating {side}")
        found.append(judged(again, made, (), mark_sigma=mark_sigma, name=side, stored=camera))
    pairs, unpaired = None, ""
    # Views of a rig that was solved without pairs may be of different moments, though their images are named alike.
    solved_apart = rig.calibration is not None and not rig.calibration.pairs
    if result is None and observations and len(rig) == 2 and not solved_apart:
        pairs, unpaired = _pairs(rig, observations)
    verdict = kcal.report.rig_verdict(
        rig, needs, mark_sigma=mark_sigma, result=result, pairs=pairs, unpaired=unpaired,
        cameras=[one.verdict for one in found], subject=name,
    )  # fmt: skip

    def drawn() -> dict[str, bytes]:
        """With those of the cameras, named as findings of a rig name them."""
        own = {f"{one.subject}-{picture}": data for one, make, _ in found for picture, data in make().items()}
        if result is None:
            return own
        return {"rig": rooms.picture_bytes(kcal.report.rig_figure(result, narrow=True))} | own

    # Tables of cameras that were not calibrated again are as the rig's file has them.
    again_made = [] if result is not None else [table for one in found for table in one.tables]
    stored = (table for side, camera in rooms.named_cameras(rig) for table in rooms.camera_tables(camera, name=side))
    return Judged(verdict, drawn, again_made or [*stored])


def _pairs(rig: kcal.Rig, observations: Sequence[Path]) -> tuple[tuple[rooms.Tensor, rooms.Tensor] | None, str]:
    """Corners of the board and pixels of pairs of views, or why there are none."""
    left, right = (kcal.Observations.load(file) for file in observations)
    try:
        matched = kcal.rig.pair_by_name(left.names, right.names)
        boards = kcal.rig.paired_boards((rig.left, rig.right), (left, right), matched)
    except InputError as error:
        return None, str(error)
    return (boards.points, boards.pixels), ""


# `kcal check`: are the error bars of a camera or a rig true, here and at these ranges?

# Exit code of a run that was interrupted, as in all commands.
_INTERRUPTED = 130
# Bytes of a file of refits that is read.
_LARGEST_RUN = 2**28
# Seconds between two writes of what is done.
_OFTEN = 5.0


def check_command(
    camera: Annotated[Path, CALIBRATED_OR_RIG],
    *,
    ranges: kinds.Table | None = None,
    marks: kinds.Marks | None = None,
    pixel_sigma: kinds.PixelSigma | None = None,
    observations: kinds.Observed | None = None,
    distance: Several[kinds.Distance] | None = None,
    against: kinds.Observed | None = None,
    refits: Annotated[int, Kind(metavar="N", least=10)] = 100,
    picture: kinds.Picture | None = None,
    output: kinds.Output | None = None,
) -> None:
    """Are the error bars of a camera or a rig true, here and at my ranges? Yes or no.

    Of a rig: points whose ranges you know (--ranges) are located, and all errors are compared jointly with what the rig
    states. If they contradict it, yaw, scale or noise is named, whichever explains them best.

    Of a camera: simulates its own capture again and again: its poses, corners, noise and motion, with true cameras and
    boards drawn from what the calibration leaves open. Each is calibrated, and its error is compared with what the
    camera file states, over the image and at each range. A hundred take about a minute.

    That supposes that the model can describe lens and board. Two tests do not: halves of the views, and the default
    lens where another was chosen, must agree with the camera; and so must a second capture (--against), which is
    calibrated, too.

    What is done is kept: after an interruption the same command continues.

    The exit code is 0 if the intervals are true, 3 if they are not, 1 if that could not be measured, 130 if it was
    interrupted.

    **Examples**

    `kcal check left.camera.json --distance 1km --picture check.png`

    `kcal check left.camera.json --against december.obs.json`

    `kcal check rig.json --ranges known.csv`

    Args:
        camera: Camera file from `kcal calibrate`, or rig file from `kcal rig`.
        ranges: Of a rig: known ranges in meters from the left camera, and their standard deviations
            (name,left_u,left_v,right_u,right_v,range,range_sigma).
        marks: Where the pixels of --ranges are, by name, if they are not in the same table.
        observations: What it was calibrated from; found beside the camera if not given.
        distance: Of what you look at, one or more: 800, 5km, inf. Far away if not given.
        against: A second capture of this camera: is it where the first one says?
        refits: Captures to simulate.
        picture: map of where the intervals are right.
        output: File of the refits that are done (.npz); CAMERA.check.npz if not given.
    """
    of_camera = observations, distance, against, picture, output
    if file_kind(camera) == "rig":
        if ranges is None or any(of_camera):
            raise InputError("a rig is checked against known ranges, --ranges, without options that are of a camera")
        _check_ranges(camera, ranges, marks, pixel_sigma)
        return
    if ranges or marks:
        raise InputError("--ranges and --marks are of a rig; give a rig file from kcal rig")
    name = camera.name.removesuffix(".json").removesuffix(".camera")
    kept = check_writable(output or camera.with_name(f"{name}.check.npz"), camera)

    at = distance or [math.inf]
    result, options, fingerprint = _calibration_of(camera, observations)
    done, whole = _all_refits(result, options, at, refits, fingerprint, kept)
    if len(done) < rooms.FEWEST:
        err.print(f"interrupted after {len(done)} of {refits} refits: too few to tell; {kept} has them", markup=False)
        raise typer.Exit(_INTERRUPTED)
    found = rooms.interval_check(result, at, done)
    fine = _told_refits(found, len(done))
    if whole:
        fine = _told_views(result, options) and fine
        if against is not None:
            fine = _told_against(result, against, options, at) and fine
    if picture is not None:
        print_wrote(kcal.report.save_picture(picture, rooms.interval_figure(found, result.observations, camera.name)))
    print_wrote(kept)
    if not whole:
        err.print(f"interrupted after {len(done)} of {refits} refits; the same command continues", markup=False)
        raise typer.Exit(_INTERRUPTED)
    if not fine:
        raise typer.Exit(NO)


def _check_ranges(path: Path, ranges: Path, marks: Path | None, sigma: float | None) -> None:
    """Print known and measured ranges, and whether they agree."""
    rig, points = rooms.load_pair(path), rooms.read_known_ranges(ranges, marks)
    noise, note = pixel_sigma_and_source(sigma, rig)
    found = kcal.locate.check_ranges(rig, points.marks, points.ranges, points.sigmas, pixel_sigma=noise)
    heads = {"known_m": "known m", "sigma_m": "±", "measured_m": "measured m", "low_m": "low", "high_m": "high"}
    columns: Columns = {
        "name": "point",
        **{name: (head, "{:.4g}") for name, head in heads.items()},
        "pull": ("error / σ", "{:+.2f}"),
    }
    numbers = (found.known, points.sigmas, found.measured, found.low, found.high, found.pulls)
    rows = [*zip(found.names, *(column.tolist() for column in numbers), strict=True)]
    tell_table("ranges", Table(columns, rows))
    if note and points.marks.covariance is None:
        out.print(note, markup=False)
    print_answer(found.true, found.text)
    tell(
        true=found.true, chi2=found.chi2, points=len(rows), probability=found.probability,
        causes=[cause._asdict() for cause in found.causes], findings=[one.content() for one in found.findings],
    )  # fmt: skip
    if not found.true:
        raise typer.Exit(NO)


def _calibration_of(
    path: Path, observations: Path | None
) -> tuple[rooms.CameraCalibrationResult, kcal.CalibrationOptions, str]:
    """The calibration, with residuals and poses, which a camera file does not have; and the file's fingerprint."""
    camera = kcal.load_camera(path)
    if camera.calibration is None or camera.calibration.known(camera.params.detach()) is None:
        raise InputError(
            f"{path}: the camera has no error bars that could be checked; calibrate it with kcal calibrate"
        )
    record = camera.calibration.record
    name = record.observations if record else None
    file = observations or path.parent / Path(name or "").name
    if observations is None and not (name and file.exists()):
        wanted = f" ({name})" if name else ""
        raise InputError(f"{path}: its observations{wanted} are not beside it; name them with --observations")
    result, options = calibrated_again(camera, file, "calibrating")
    others, _ = rooms.other_views(camera, result)
    if others:
        raise InputError(f"{file}: {others[0].sentence}")
    return result, options, camera.fingerprint


def _all_refits(
    result: rooms.CameraCalibrationResult,
    options: kcal.CalibrationOptions,
    ranges: list[float],
    count: int,
    fingerprint: str,
    path: Path,
) -> tuple[list[rooms.Refit], bool]:
    """So many refits, those of an earlier run included; and whether these are all."""
    # That of the file: a calibration that is made again differs in the last digits.
    text = repr((fingerprint, [view.pixels for view in result.observations.views], ranges, rooms.GRID))
    key = hashlib.sha256(f"{kcal.__version__}{text}".encode()).hexdigest()[:16]
    done = _kept_refits(path, key)[:count]
    if done:
        out.print(f"{len(done)} refits are done already ({path})", markup=False)
    todo = sorted({*range(count)} - {refit.seed for refit in done})
    saved = time.monotonic()
    with suppress(KeyboardInterrupt), steps("refits", count) as advance:
        advance("", len(done))
        for refit in rooms.simulated_refits(result, options, ranges, todo):
            done.append(refit)
            advance(f"{len(done)} of {count}")
            if time.monotonic() - saved > _OFTEN:
                _keep_refits(path, key, done)
                saved = time.monotonic()
    if todo and done:
        _keep_refits(path, key, done)
    return done, len(done) == count


def _keep_refits(path: Path, key: str, refits: list[rooms.Refit]) -> None:
    import numpy as np

    parts = {name: np.stack([np.asarray(getattr(one, name)) for one in refits]) for name in ("seed", "errors")}
    with open_atomic(path) as file:
        np.savez_compressed(file, allow_pickle=False, kcal=np.array("check"), key=np.array(key), **parts)


def _kept_refits(path: Path, key: str) -> list[rooms.Refit]:
    """The refits of an earlier run; none where the file is of another camera, other ranges or another version."""
    if not path.exists():
        return []
    arrays = rooms.read_npz(read_bytes(path, _LARGEST_RUN), str(path), _LARGEST_RUN, "run of kcal check")
    if str(arrays.get("kcal")) != "check":
        raise FileError(f"{path}: not a file of kcal check; choose another name with -o")
    if str(arrays.get("key")) != key:
        warn(f"{path} has refits of another camera, capture, range or version of kcal; they are made anew")
        return []
    try:
        parts = zip(arrays["seed"].tolist(), rooms.torch.from_numpy(arrays["errors"]), strict=True)
        return [rooms.Refit(seed, errors) for seed, errors in parts]
    except (KeyError, TypeError, ValueError) as error:
        raise FileError(f"{path}: damaged; remove it and start again") from error


def _tenths(share: float) -> str:
    """Of a percent."""
    return f"{100 * share:.1f}"


def _told_refits(found: rooms.IntervalCheck, count: int) -> bool:
    """Print the answer."""
    columns: Columns = {
        "range_m": ("range", rooms.range_label), "share": ("refits inside, %", _tenths), "share_error": ("±", _tenths),
        "lowest_share": ("lowest place, %", lambda share: f"{100 * share:.0f}"),
        "error_px": ("error px, RMS", "{:.3g}"), "stated_px": ("stated px, RMS", "{:.3g}"),
        "factor": ("σ should be", "x {:.2f}"),
    }  # fmt: skip
    lowest = [float(places[places.isfinite()].min()) for places in found.coverage]
    parts = zip(found.ranges, found.shares, lowest, found.rms, found.factors, strict=True)
    rows = [[at, *shares, least, *rms, factor] for at, shares, least, rms, factor in parts]
    tell_table("ranges", Table(columns, rows))
    if found.failed:
        warn(f"{found.failed} of {count} simulated captures could not be calibrated; they are not counted")
    worst = min(range(len(rows)), key=lambda i: found.shares[i][0])
    share, where = 100 * found.shares[worst][0], rooms.range_label(found.ranges[worst])
    how = "true" if found.true else "too narrow"
    cure = "" if found.true else f"; multiply σ by {found.factors[worst]:.2f}, or take more views"
    text = f"the stated 95 % intervals are {how}: they contain {share:.0f} % of {count} refits, {where}{cure}"
    print_answer(found.true, text)
    tell(true=found.true, refits=count, failed=found.failed)
    return found.true


def _told_views(result: rooms.CameraCalibrationResult, options: kcal.CalibrationOptions) -> bool:
    """Print whether the capture's own views contradict the intervals: by their halves, and by the default lens."""
    with steps("examining the views", None) as advance:
        fault = rooms.fault_of_views(result, options, advance)
    if fault is None:
        print_answer(True, "its own views say nothing against lens model and board")
    else:
        print_answer(False, f"its own views contradict the stated intervals: {fault.sentence}")
    tell(fault=None if fault is None else fault.text)
    return fault is None


def _told_against(
    result: rooms.CameraCalibrationResult, path: Path, options: kcal.CalibrationOptions, ranges: list[float]
) -> bool:
    """Print whether a second capture gives the same camera."""
    second = kcal.Observations.load(path)
    check_views_of([result.camera], [second], [path])
    with steps(f"calibrating {path.name}", None):
        found = rooms.against_capture(result, second, options, ranges)
    columns: Columns = {
        "range_m": ("range", rooms.range_label), "seen_px": ("seen px, RMS", "{:.3g}"),
        "predicted_px": ("predicted px, RMS", "{:.3g}"), "ratio": ("seen / predicted", "{:.2f}"),
        "probability": ("probability", "{:.2g}"),
    }  # fmt: skip
    rows = []
    for at, one in zip(ranges, found, strict=True):
        ratio, chance = one.ratio or math.nan, one.probability if one.probability is not None else math.nan
        rows.append([at, one.rms, one.rms / ratio, ratio, chance])
    tell_table("against", Table(columns, rows))
    same = all(bool(one.same) for one in found)
    verdict = "agrees with" if same else "contradicts"
    more = "" if same else ": a lens or board that the model does not describe, or a camera that changed"
    print_answer(same, f"the second capture {verdict} the stated intervals{more}")
    tell(against_same=same)
    return same
