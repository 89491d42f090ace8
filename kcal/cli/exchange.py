"""`kcal export` and `kcal import`: cameras for other programs, and from them."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Annotated, Any

import orjson

import kcal
from kcal.cli import kinds, rooms
from kcal.cli.console import out, print_table, print_wrote, steps, tell, warn
from kcal.cli.inputs import cameras_and_rig, named_source, picked
from kcal.cli.options import Kind
from kcal.errors import InputError
from kcal.files import write_atomic

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
            text = f"{label}, fitted: RMS {misfit.rms:.2g} px, at most {misfit.largest:.2g} px over the image"
            out.print(text)
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
    board: kinds.Inner | None = None,
    square: Annotated[kinds.Side, Kind(of="board")] | None = None,
    survey_sigma: kinds.Sigma | None = None,
    geoid: kinds.Meters | None = None,
    unit: kinds.Unit | None = None,
    topic: Annotated[str, Kind(metavar="TOPIC")] | None = None,
) -> None:
    """Read a camera or a rig from a file of another program.

    The format is recognized. Cameras with their relative poses become a rig file. With --board, corners become an
    observations file: mrcal's corners.vnl, CSV (image,u,v,weight), image_points of OpenCV's sample, and MATLAB's
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
        out.print(f"{len(seen.views)} views with {corners} corners, {weights}")
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
    schema["properties"] = {
        "kcal": {"const": file.KIND},
        "version": {"const": file.VERSION},
        **schema["properties"],
    }
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
