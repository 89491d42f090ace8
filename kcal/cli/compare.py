"""Commands about a camera as a whole: `kcal compare`, `kcal diff`, `kcal interpolate` and `kcal bake`."""

from __future__ import annotations

import functools
import math
from typing import Annotated, Any

import kcal
from kcal.cli import kinds, rooms
from kcal.cli.console import out, print_wrote, steps, tell, tell_table, warn
from kcal.cli.inputs import single_camera
from kcal.cli.options import Kind, Several
from kcal.errors import InputError
from kcal.files import check_writable, write_atomic
from kcal.table import Columns, Table
from kcal.texts import number_text

# `kcal compare`: how well lens models predict views that were held out.


def compare_command(
    observations: kinds.Observed,
    models: list[str] | None = None,
    *,
    model: Several[str] | None = None,
    groups: str = "blocks",
    parts: Annotated[int, Kind(metavar="N", least=2)] = 5,
    output: kinds.NewFile | None = None,
    picture: kinds.Picture | None = None,
) -> None:
    """Compare lens models on views that were held out. A tool for research: calibrating needs no model to choose.

    Every model is fitted without a part of the views, and its RMS is measured on these, with only the board's poses
    solved again. The standard error of each difference tells what the capture can decide.

    **Example**

    `kcal compare left.obs.json --model hybrid opencv5 opencv14`

    `kcal compare left.obs.json --model hybrid opencv14 -o models.csv --picture models.png`

    Args:
        observations: Observations file from `kcal detect`.
        models: More models.
        model: Models to compare, for example hybrid opencv5 opencv14.
        groups: Hold out blocks of views together (blocks), or views one by one (views).
        parts: Number of times that a part of the groups is held out.
        output: The same numbers, to write (.csv).
        picture: held-out RMS of each model with its standard error.
    """
    if groups not in ("blocks", "views"):
        raise InputError(f"--groups {groups}: write blocks or views")
    names = [*(model or []), *(models or [])]
    if not names:
        raise InputError("name the models to compare, for example --model hybrid opencv5 opencv14")

    if output is not None and output.suffix.lower() != ".csv":
        raise InputError(f"{output}: the name of a table must end with .csv")

    seen = kcal.Observations.load(observations)
    with steps("comparing", parts * len(names)) as advance:
        result = kcal.calibrate.compare_models(
            seen, names, groups="views" if groups == "views" else "blocks", parts=parts, progress=advance
        )
    count = len(result.corners)
    out.print(f"{len(seen.views)} views; held out in {count} groups, {parts} parts; RMS per corner")
    columns: Columns = {
        "model": "model", "held_out_rms_px": "held-out RMS, px", "more_than_best_px": "more than the best, px",
        "standard_error_px": "± standard error",
    }  # fmt: skip
    rows: list[list[Any]] = [
        [name, (rms, number_text(rms, digits=4)), (more, number_text(more, error)), (error, number_text(error, error))]
        for name, rms, more, error in result.ranking
    ]
    table = Table(columns, [[*rows[0][:2], None, None], *rows[1:]])
    tell_table("models", table)
    if output is not None:
        write_atomic(output, table.csv)
    if picture is not None:
        kcal.report.save_picture(picture, rooms.models_figure(result, observations.name))
    print_wrote(output, picture)
    for name, reason in result.failures.items():
        warn(f"{name} could not be fitted to some of the views: {reason}")


# `kcal diff`: how differently two cameras see, against their error bars.


def diff_command(
    first: kinds.AnyCamera,
    second: kinds.AnyCamera,
    *,
    distance: kinds.Distance = math.inf,
    turn: bool = True,
    picture: kinds.Picture | None = None,
) -> None:
    """Compare two calibrations of a camera: are they the same within their uncertainty?

    Where the second camera sees what the first one sees, after the turn that no calibration determines. The error bars
    of both tell how much of that is expected. Use it for one camera over time, or for two halves of its images.

    **Examples**

    `kcal diff june.camera.json december.camera.json --picture diff.png`

    `kcal diff left.camera.json left.cameramodel`

    Args:
        first: Camera file of kcal or of another program.
        second: Another one; RIG.json:left is a camera of a rig.
        distance: Of what is seen.
        turn: Turn the second camera until it agrees best with the first.
        picture: maps of the difference and of its σ.
    """
    cameras = [single_camera(source) for source in (first, second)]
    records = [camera.calibration.record if camera.calibration else None for camera in cameras]
    then, now = (record.temperature if record else None for record in records)
    for source, camera, record in zip((first, second), cameras, records, strict=True):
        out.print(f"{source}: {_history(camera, record)}")
    found = kcal.lens.camera_difference(*cameras, at=distance, rotation=None if turn else rooms.torch.eye(3))
    tell(
        at_m=None if math.isinf(distance) else distance,
        rms_px=found.rms,
        largest_px=found.largest,
        turn_deg=found.turn_deg,
        ratio=found.ratio,
        probability=found.probability,
        same=found.same,
        temperature_c=[then, now],
    )
    if then is not None and now is not None and now != then:
        out.print(f"{abs(now - then):g} °C {'warmer' if now > then else 'colder'}")
    for line in rooms.difference_text(found):
        out.print(line)
    if picture is not None:
        print_wrote(kcal.report.save_picture(picture, rooms.difference_figure(found, title=f"{first} and {second}")))


def _history(camera: kcal.Camera, record: rooms.CalibrationRecord | None) -> str:
    """Model, focal length and, if the file tells, when the camera was calibrated."""
    when = ""
    if record:
        when = f", {record.created:%Y-%m-%d %H:%M}, RMS {number_text(record.rms)} px from {record.views} views"
    if camera.calibration and camera.calibration.setting:
        when += f", {camera.calibration.setting}"
    if record and record.temperature is not None:
        when += f", at {record.temperature:g} °C"
    return f"{camera.model}, focal length {rooms.paraxial_focal(camera)}{when}"


# `kcal interpolate`: a camera at a setting of zoom or focus between those at which its lens was calibrated.


def interpolate_command(
    cameras: list[kinds.CalibratedCamera], *, setting: kinds.Setting, output: kinds.NewFile
) -> None:
    """Make a camera at a zoom or focus between those at which its lens was calibrated, with its error bars.

    Error bars grow by what the curve between the settings may hide: three settings tell little of that, five tell more.
    Outside the settings nothing is made. Commands take the file as they take any camera file.

    **Example**

    `kcal interpolate near.camera.json middle.camera.json far.camera.json --setting focus=4±0.1 -o now.camera.json`

    Args:
        cameras: Camera file at each setting, from `kcal calibrate --setting`.
        setting: Setting of the camera to make, and the standard deviation with which the lens comes back to it (0 if
            not given); may be repeated.
        output: Camera file to write.
    """
    wanted = {name: one.value for name, one in setting.items()}
    spread = {name: one.sigma for name, one in setting.items() if one.sigma is not None}

    loaded = [kcal.load_camera(path) for path in cameras]
    found = rooms.camera_at_setting(loaded, wanted, setting_sigma=spread, names=[str(path) for path in cameras])
    *stood, made = [camera.calibration and camera.calibration.setting for camera in (*loaded, found.camera)]
    weight = functools.partial(number_text, sigma=0.01, sign=True)
    rows = [*zip(map(str, cameras), map(str, stood), found.weights, strict=True)]
    table = Table({"camera": "camera", "setting": "setting", "weight": ("weight", weight)}, rows)
    tell_table("cameras", table, left=(0, 1))
    parts = {
        "calibrations": found.calibration_px,
        "interpolation": found.interpolation_px,
        "setting": found.setting_px,
        "misfit": found.misfit_px,
    }
    total = sum(value**2 for value in parts.values()) ** 0.5
    how, whence = "calibrated", ""
    if isinstance(made, kcal.lens.LensSetting) and made.interpolated_from:
        by = [f"{number_text(value, digits=2)} by {name}" for name, value in parts.items() if value]
        how, whence = "interpolated", f": {', '.join(by)}"
    known = f"points at infinity ± {number_text(total, digits=2)} px (median)"
    out.print(f"{made}, {how}: {known}{whence}")
    tell(setting=wanted, sigma_px={"median": total, **parts})
    kcal.save_camera(found.camera, output, name=output.name.split(".")[0])
    print_wrote(output)


# `kcal bake`: a camera as lookup tables.


def bake_command(
    camera: kinds.CameraFile,
    *,
    output: kinds.NewFile | None = None,
    tolerance: Annotated[float, Kind(metavar="PX", least=1e-8)] = 1e-3,
) -> None:
    """Turn a camera into lookup tables, for programs without lens models.

    Writes one .npz file with two bicubic tables, pixels to rays and rays to pixels, as coarse as the tolerance allows.
    `kcal/io/lookup_file.py` explains the arrays and how to read them with numpy alone.

    **Example**

    `kcal bake left.camera.json --tolerance 0.001 -o left.npz`

    Args:
        camera: Camera file from `kcal calibrate`.
        output: File to write (.npz); beside the camera file if not given.
        tolerance: Largest allowed error in pixels, in both directions.
    """
    name = camera.name.removesuffix(".json").removesuffix(".camera")
    path = check_writable(output or camera.with_name(f"{name}_lookup.npz"), camera)

    with steps("baking", None):
        lookup = kcal.lens.bake(single_camera(camera), tolerance)
    kcal.lens.save_lookup(lookup, path)
    for which, table, bound, coverage in zip(
        ("pixels to rays", "rays to pixels"),
        (lookup.chart_from_pixels, lookup.pixels_from_chart),
        lookup.bound[::-1],
        lookup.coverage[::-1],
        strict=True,
    ):
        rows, columns = table.cells.shape
        lost = "" if coverage == 1.0 else f"; answers for {coverage:.1%} of the image's valid pixels"
        out.print(f"{which}: {columns} x {rows} cells, error at most {bound:.1e} px{lost}")
    print_wrote(path)
