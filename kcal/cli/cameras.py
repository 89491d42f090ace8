"""Cameras as a whole: `kcal export`, `import`, `compare`, `diff`, `interpolate`, `bake`; and `kcal schema`."""

from __future__ import annotations

import functools
import importlib
import math
from pathlib import Path
from typing import Annotated, Any

import orjson

import kcal
from kcal.cli import kinds, rooms
from kcal.cli.console import draw_picture, out, print_table, print_wrote, steps, tell, tell_table, warn
from kcal.cli.inputs import cameras_and_rig, named_source, picked, single_camera
from kcal.cli.options import Kind, Several
from kcal.errors import InputError
from kcal.files import check_writable, write_atomic
from kcal.table import Columns, Table
from kcal.texts import counted_text, number_text

# `kcal export` and `kcal import`: cameras for other programs, and from them.

# Pixels (RMS) beyond which a lens model does not stand for a lens.
_FAR = 0.5


def export_command(
    source: kinds.AnyFile,
    *,
    output: kinds.NewFile,
    format: kinds.Name | None = None,
    model: kinds.Name | None = None,
    picture: kinds.Picture | None = None,
) -> None:
    """Write a camera or a rig for another program.

    The format follows from the suffix: .yaml and .xml OpenCV, .bag, .mcap and .db3 bags of ROS with tf, .cameramodel
    mrcal, .txt and .bin COLMAP, .json nerfstudio, .mat MATLAB, .toml aniposelib, .npz maps for cv2.remap. Others are
    named by --format. A lens that the format cannot hold is never cut short: the nearest model of the format is fitted,
    and its error over the image is printed. Pixel origins are converted.

    What is known of a camera goes along as a prior for bundle adjustment: the parameters in the program's order and
    their square-root information, in NAME.prior.json.

    **Examples**

    `kcal export left.camera.json -o left.yaml`

    `kcal export rig.json --format kalibr -o camchain.yaml`

    `kcal export left.camera.json --format gtsam -o left.gtsam.json`

    `kcal export left.camera.json -o left.cameramodel --picture misfit.png`

    Args:
        source: Camera or rig of kcal; RIG.json:left is one of its cameras.
        output: File to write.
        format: opencv, ros, bag, kalibr, basalt, mrcal, colmap, nerfstudio, matlab, opensfm, toml, multical, gtsam,
            ceres, numpy or remap.
        model: Lens model of the format to fit, for example opencv5, or a lens of the program, for example ds.
        picture: error of a refitted lens over the image.
    """
    path, name = named_source(source)

    found, rig = cameras_and_rig(path)
    alone = name is not None or len(found.cameras) == 1
    chosen = picked(found, name, source) if alone else rig or found.cameras
    with steps("fitting what the format holds", None):
        done = kcal.lens.export_cameras(chosen, output, format=format, model=model)
    names = (name or found.names[0],) if alone else found.names
    for camera, model_name, misfit in zip(names, done.models, done.misfits, strict=True):
        label = f"{camera or 'camera'}: {model_name}"
        if misfit is None:
            out.print(f"{label}, {'baked' if done.format == 'remap' else 'exact'}")
        else:
            out.print(f"{label}, fitted: RMS {misfit.rms:.2g} px, at most {misfit.largest:.2g} px over the image")
            if misfit.rms > _FAR:
                warn(
                    f"{camera or 'camera'}: no lens model of {done.format} comes nearer; mrcal files (.cameramodel) "
                    "hold this lens, and maps for cv2.remap (.npz) its undistorted image"
                )
    warn(*done.notes)
    if done.lost:
        out.print(f"not in the file: {', '.join(done.lost)}")
    fitted = [(camera, misfit) for camera, misfit in zip(names, done.misfits, strict=True) if misfit is not None]
    if picture is not None and fitted:
        camera, misfit = max(fitted, key=lambda each: each[1].largest)
        title = f"{source}: {camera}" if len(names) > 1 else source
        print_wrote(kcal.report.save_picture(picture, rooms.difference_figure(misfit, title=title)))
    elif picture is not None:
        out.print("no picture: nothing was refitted")
    print_wrote(*done.paths)


def import_command(
    sources: list[kinds.ForeignFile],
    *,
    output: kinds.NewFile,
    format: kinds.Name | None = None,
    size: kinds.Size | None = None,
    fisheye: bool | None = None,
    board: Annotated[str, Kind(metavar="CxR")] | None = None,
    square: Annotated[str, Kind(metavar="LENGTH", of="board")] | None = None,
    survey_sigma: kinds.Sigma | None = None,
    geoid: kinds.Meters | None = None,
    unit: kinds.Unit | None = None,
    topic: Annotated[str, Kind(metavar="TOPIC")] | None = None,
) -> None:
    """Read a camera or a rig from a file of another program.

    The format is recognized. Cameras with their relative poses become a rig file. With --board, corners become an
    observations file: mrcal's corners.vnl, CSV (image,u,v,weight), image_points of OpenCV's samples, and MATLAB's
    imagePoints. GeoJSON and GPX become a survey.csv for `kcal rig --landmarks`.

    **Examples**

    `kcal import left.yaml -o left.camera.json`

    `kcal import intrinsics.yml extrinsics.yml --size 640x480 --unit mm -o rig.json`

    `kcal import cameras.txt:2 -o second.camera.json`

    `kcal import run.mcap --topic /left/camera_info -o left.camera.json`

    `kcal import corners.vnl --board 10x10 --square 58.8mm --size 6000x3376 -o left.obs.json`

    `kcal import places.gpx --survey-sigma 0.02 --geoid -67.3 -o survey.csv`

    Args:
        sources: File of another program, FILE:NAME for one of its cameras; two files of a pair.
        output: Camera or rig file to write.
        format: opencv, ros, bag, kalibr, mrcal, colmap, nerfstudio, matlab, opensfm, toml, qualisys, agisoft or device.
        size: Image size, where the file has none or a wrong one.
        fisheye: Whether four coefficients of OpenCV are a fisheye's.
        board: Read corners instead, of a board with these inner corners.
        square: Side of a square of the board with its unit: 25mm.
        survey_sigma: Of surveyed places, along each axis, where the file has none.
        geoid: Height of the geoid above the WGS84 ellipsoid, added to the elevations of GPX.
        unit: Unit of the translation, where the file has none: mm, cm, m, in.
        topic: Of a bag of ROS with several cameras: its CameraInfo, or the images.
    """
    named = [named_source(source) for source in sources]
    paths, camera = [path for path, _ in named], next((name for _, name in named if name), topic)
    what = "corners" if board is not None else "places" if paths[0].suffix.lower() in (".gpx", ".geojson") else ""
    if what and len(paths) > 1:
        raise InputError(f"{what} are read from one file{', with --board and --square' if board is not None else ''}")
    if board is not None:
        seen = rooms.import_corners(paths[0], kcal.Board.parse(board, square), size)
        seen.save(output)
        weights = "with weights" if seen.covariances() is not None else "without weights"
        corners = sum(int(view.seen.sum()) for view in seen.views)
        out.print(f"{counted_text(len(seen.views), 'view')} with {corners} corners, {weights}")
    elif what:
        _import_survey(paths[0], output, survey_sigma, geoid)
    else:
        _import_cameras(paths, camera, output, format=format, size=size, fisheye=fisheye, meters=unit)
    print_wrote(output)


def _import_cameras(paths: list[Path], camera: str | None, output: Path, **stated: Any) -> None:
    """Read a camera, that of the name if there is one, or a rig, and write its file."""
    found = kcal.lens.import_cameras(*paths, **stated)
    warn(*found.notes)
    if camera is None and len(found.poses) > 2 and not found.unread:
        kcal.save_rig(found.camera_rig(), output)
        out.print(f"rig from {found.format}: {', '.join(found.names)}")
    elif camera is None and found.is_rig() and not found.unread:
        rig = found.rig()
        kcal.save_rig(rig, output)
        out.print(f"rig from {found.format}: baseline {float(rig.baseline):.6g} m")
    else:
        chosen = picked(found, camera, " ".join(map(str, paths)))
        kcal.save_camera(chosen, output)
        out.print(f"camera from {found.format}: {chosen.model}, {chosen.size[0]}x{chosen.size[1]} px")
    known = [one.calibration is not None and one.calibration.covariance is not None for one in found.cameras]
    if without := [name for name, stated in zip(found.names, known, strict=True) if not stated]:
        out.print(
            f"no error bars in the file: {', '.join(without)}. A rig takes such a camera as exact, and no σ knows "
            "the lens's errors"
        )


def _import_survey(source: Path, output: Path, sigma: float | None, geoid: float | None) -> None:
    survey = kcal.rig.import_survey(source, sigma=sigma, geoid=geoid)
    assert survey.origin is not None
    places = kcal.locate.enu_to_geodetic(survey.points, survey.origin).tolist()
    rows = (
        [name, f"{lat:.11f}", f"{lon:.11f}", f"{height:.5f}", level, up]
        for name, (lat, lon, height), (level, _, up) in zip(survey.names, places, survey.sigma.tolist(), strict=True)
    )
    write_atomic(output, rooms.places_csv(rooms.EARTH, rows))
    out.print(f"{len(places)} places")


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
    draw_picture(picture, lambda: rooms.models_figure(result, observations.name))
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
    out.print("\n".join(rooms.difference_text(found)))
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
    out.print(f"{made}, {how}: points at infinity ± {number_text(total, digits=2)} px (median){whence}")
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
    tables = ("pixels to rays", lookup.chart_from_pixels), ("rays to pixels", lookup.pixels_from_chart)
    for (which, table), bound, coverage in zip(tables, lookup.bound[::-1], lookup.coverage[::-1], strict=True):
        rows, columns = table.cells.shape
        lost = "" if coverage == 1.0 else f"; answers for {coverage:.1%} of the image's valid pixels"
        out.print(f"{which}: {columns} x {rows} cells, error at most {bound:.1e} px{lost}")
    print_wrote(path)


# `kcal schema`: the JSON schema of each of kcal's own files.

# Kind, class, and which command writes it.
FILES = {
    "camera": ("kcal.io.camera_file", "CameraFile", "kcal calibrate"),
    "rig": ("kcal.io.rig_file", "RigFile", "kcal rig, kcal station"),
    "observations": ("kcal.corners.observations", "Observations", "kcal detect"),
    "board": ("kcal.calibrate.hybrid.measured_board", "BoardFile", "kcal board measure"),
}


def file_schema(kind: str) -> dict[str, Any]:
    """The schema (JSON Schema 2020-12) of a kind of file, with the version that this kcal writes.

    Example:
        >>> schema = file_schema("camera")
        >>> schema["properties"]["kcal"], schema["required"][:3]
        ({'const': 'camera'}, ['kcal', 'version', 'name'])
    """
    module, name, _ = FILES[kind]
    file = getattr(importlib.import_module(module), name)
    schema = file.model_json_schema(mode="serialization")
    schema["properties"] = {"kcal": {"const": file.KIND}, "version": {"const": file.VERSION}, **schema["properties"]}
    # All fields of the version's first files are written, so that a reader need not know their defaults.
    schema["required"] = [name for name in schema["properties"] if name not in file._LATER]
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"kcal {file.KIND} file, version {file.VERSION}",
        **{key: value for key, value in schema.items() if key != "title"},
    }


def schema_command(kind: str | None = None) -> None:
    """Print the JSON schema of a kind of file, for programs that read or check kcal's files.

    What a schema cannot say (that a covariance is one, or that names fit the model) is checked when kcal reads a file.

    **Example**

    `kcal schema camera > camera.schema.json`

    Args:
        kind: camera, rig, observations or board; a list of them if not given.
    """
    if kind is None:
        print_table([["kind", "written by"], *([name, writer] for name, (*_, writer) in FILES.items())], left=(0, 1))
        return
    if kind not in FILES:
        raise InputError(f"kcal schema: no kind of file is called {kind!r}; kinds: {', '.join(FILES)}")
    tell(schema=file_schema(kind))
    out.print(orjson.dumps(file_schema(kind), option=orjson.OPT_INDENT_2).decode())
