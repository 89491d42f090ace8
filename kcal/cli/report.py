"""`kcal report`: may this camera or rig be used, and one page that says why."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

import kcal
from kcal.cli import kinds
from kcal.cli.console import print_styled, print_wrote, steps, tell
from kcal.cli.inputs import CAMERA_OR_RIG, pixel_sigma_of, single_camera
from kcal.cli.options import Several
from kcal.cli.rig_sources import cameras_of_files, check_views_of
from kcal.errors import InputError
from kcal.file_kind import file_kind

if TYPE_CHECKING:
    from torch import Tensor

    from kcal.calibrate.camera.result import CameraCalibrationResult
    from kcal.calibrate.rig.result import RigResult
    from kcal.finding import Finding
    from kcal.report.verdict import Verdict

# A verdict, how the pictures of its page are drawn, and its tables.
Judged: TypeAlias = "tuple[Verdict, Callable[[], dict[str, bytes]], list[list[list[str]]]]"
# The exit code of a no, apart from errors (1) and wrong usage (2).
NO = 3


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
    found = (
        _of_rig(subject, given, needs, pixel_sigma)
        if file_kind(subject) == "rig"
        else _of_camera(subject, given, needs, baseline, pixel_sigma_of(pixel_sigma))
    )
    tell(verdict=found[0].to_dict())
    if not told_usable(found, output):
        raise typer.Exit(NO)


def told_usable(found: Judged, page: Path | None, warned: Iterable[Finding] = ()) -> bool:
    """Print a verdict and write its page; returns whether it is a yes.

    Args:
        found: the verdict, and what its page shows.
        page: to write.
        warned: findings of which the command has warned already.
    """
    from kcal.report.pages import range_rows, save_verdict_page

    verdict, pictures, tables = found
    for line in verdict.lines(warned):
        style = {"  met:": "green", "  miss": "red"}.get(line[:6], "bold")
        print_styled(line, r"^(YES|NO\b|  met(?=:)|  missed(?=:))", style)
    if page is not None:
        ranges = [range_rows(verdict)] if verdict.answers else []
        with steps("drawing", None):
            drawn = pictures()
        print_wrote(save_verdict_page(page, verdict, drawn, [*ranges, *tables]))
    return verdict.usable


def warned_of(result: RigResult) -> list[Finding]:
    """Findings of which was warned when a rig was solved, and when its cameras were calibrated."""
    known = [camera.calibration.record for camera in result.data.cameras if camera.calibration]
    return [*result.findings, *(finding for record in known if record for finding in record.findings)]


def _of_camera(
    path: Path, observations: list[Path], needs: tuple[kcal.report.Requirement, ...], baseline: float, mark_sigma: float
) -> Judged:
    from kcal.report.judge_camera import stored_verdict
    from kcal.report.pages import camera_tables

    camera = single_camera(str(path))
    name = (camera.calibration.name if camera.calibration else "") or path.name.split(".")[0]
    if not observations:
        found = stored_verdict(camera, needs, baseline=baseline, mark_sigma=mark_sigma, subject=name)
        return found, dict, camera_tables(camera)
    if len(observations) > 1:
        raise InputError("a camera has one observations file; give --observations once")
    result, made = calibrated_again(camera, observations[0], f"calibrating {name}")
    return judged(result, made, needs, baseline=baseline, mark_sigma=mark_sigma, name=name, stored=camera)


def judged(
    result: CameraCalibrationResult,
    options: kcal.CalibrationOptions,
    needs: tuple[kcal.report.Requirement, ...],
    *,
    baseline: float = 10.0,
    mark_sigma: float,
    name: str,
    stored: kcal.Camera | None = None,
) -> Judged:
    """The verdict on a calibration, with the pictures and tables of its page; `stored` as in `camera_verdict`."""
    from kcal.report.pages import camera_tables
    from kcal.report.verdict_pictures import camera_pictures

    with steps(f"checking {name}", None) as advance:
        examination = kcal.calibrate.examine(result, options, advance)
    verdict = kcal.report.camera_verdict(
        result, options, needs, baseline=baseline, mark_sigma=mark_sigma, subject=name, examination=examination,
        stored=stored,
    )  # fmt: skip
    return verdict, lambda: camera_pictures(result, examination), camera_tables(result.camera, result, name)


def calibrated_again(
    camera: kcal.Camera, observations: Path, what: str
) -> tuple[CameraCalibrationResult, kcal.CalibrationOptions]:
    """A camera of a file, calibrated once more from its views: files have no residuals and no poses."""
    from kcal.calibrate.camera.trust import stored_options

    seen, options = kcal.Observations.load(observations), stored_options(camera)
    check_views_of([camera], [seen], [observations])
    with steps(what, None) as advance:
        return kcal.calibrate_camera(seen, options, advance), options


def _of_rig(
    path: Path, observations: list[Path], needs: tuple[kcal.report.Requirement, ...], pixel_sigma: float | None
) -> Judged:
    from kcal.report.judge_rig import named_cameras

    rig = kcal.load_rig(path)
    pair = rig.is_pair and rig.names == ("left", "right")
    mark_sigma = pixel_sigma_of(pixel_sigma, rig)
    cameras = named_cameras(rig)
    if pair and observations and len(observations) != 2:
        raise InputError("a rig needs --observations LEFT RIGHT")
    if not pair and observations:
        cameras = [cameras[number] for number in cameras_of_files(observations, [name for name, _ in cameras])]
    if observations:
        check_views_of(
            [camera for _, camera in cameras], [kcal.Observations.load(file) for file in observations], observations
        )
    return judged_rig(rig, observations, needs, mark_sigma=mark_sigma, name=path.name.split(".")[0], cameras=cameras)


def judged_rig(
    rig: kcal.Rig, observations: Sequence[Path], needs: tuple[kcal.report.Requirement, ...], *, mark_sigma: float,
    name: str, cameras: Sequence[tuple[str, kcal.Camera]],
) -> Judged:  # fmt: skip
    """The verdict on a rig and, with the observations of `cameras`, each with its name, on these as well."""
    found = judged_sides(cameras, observations, mark_sigma)
    # Views of a rig that was solved without pairs may be of different moments, though their images are named alike.
    if observations and len(rig) == 2 and (rig.calibration is None or rig.calibration.pairs > 0):
        pairs, unpaired = _pairs(rig, observations)
    else:
        pairs, unpaired = None, ""
    verdict = kcal.report.rig_verdict(
        rig, needs, mark_sigma=mark_sigma, pairs=pairs, unpaired=unpaired, cameras=[one[0] for one in found],
        subject=name,
    )  # fmt: skip
    tables = [table for one in found for table in one[2]]
    return verdict, lambda: side_pictures(found), tables or stored_tables(rig)


def judged_sides(
    cameras: Sequence[tuple[str, kcal.Camera]], observations: Sequence[Path], mark_sigma: float
) -> list[Judged]:
    """The verdicts on cameras of a rig, calibrated again from their observations; none without these."""
    found = []
    with steps("cameras", len(observations)) as advance:
        for (side, camera), file in zip(cameras, observations, strict=False):
            result, made = calibrated_again(camera, file, f"calibrating {side}")
            found.append(judged(result, made, (), mark_sigma=mark_sigma, name=side, stored=camera))
            advance("")
    return found


def stored_tables(rig: kcal.Rig) -> list[list[list[str]]]:
    """Tables of all cameras, as the rig's file has them."""
    from kcal.report.judge_rig import named_cameras
    from kcal.report.pages import camera_tables

    return [table for name, camera in named_cameras(rig) for table in camera_tables(camera, name=name)]


def side_pictures(cameras: Sequence[Judged]) -> dict[str, bytes]:
    """The pictures of several cameras, named as findings of a rig name them."""
    return {f"{verdict.subject}-{name}": data for verdict, pictures, _ in cameras for name, data in pictures().items()}


def _pairs(rig: kcal.Rig, observations: Sequence[Path]) -> tuple[tuple[Tensor, Tensor] | None, str]:
    """Corners of the board and pixels of pairs of views, or why there are none."""
    left, right = (kcal.Observations.load(file) for file in observations)
    try:
        boards = kcal.rig.paired_boards(
            (rig.left, rig.right), (left, right), kcal.rig.pair_by_name(left.names, right.names)
        )
    except InputError as error:
        return None, str(error)
    return (boards.points, boards.pixels), ""
