"""`kcal export` and `kcal import`: cameras for other programs, and from them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kcal.cli.camera_sources import named_source, parse_size, picked
from kcal.cli.console import out, print_wrote, warn
from kcal.errors import InputError
from kcal.files import check_writable

_UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}


def export_command(
    source: Annotated[
        str,
        typer.Argument(metavar="FILE", help="Camera or rig of kcal; RIG.json:left is one of its cameras."),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="File to write.")],
    format: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="opencv, ros, kalibr, mrcal, colmap, nerfstudio, matlab, opensfm or remap."),
    ] = None,
    model: Annotated[
        str | None, typer.Option(metavar="NAME", help="Lens model of the format to fit, for example opencv5.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Picture of the error of a refitted lens over the image.")
    ] = None,
) -> None:
    """Write a camera or a rig for another program.

    The format follows from the suffix: .yaml and .xml OpenCV, .cameramodel mrcal, .txt and .bin COLMAP, .json
    nerfstudio, .mat MATLAB, .npz maps for cv2.remap. ROS, Kalibr and OpenSfM are named by --format. A lens that the
    format cannot hold is never cut short: the nearest model of the format is fitted, and its error over the image is
    printed. Pixel origins are converted.

    **Examples**

    `kcal export left.camera.json -o left.yaml`

    `kcal export rig.json --format kalibr -o camchain.yaml`

    `kcal export left.camera.json -o left.cameramodel --picture misfit.png`
    """
    path, name = named_source(source)
    check_writable(output, path)

    from kcal.calibrate.camera.export import export_cameras
    from kcal.io.formats import import_cameras
    from kcal.report.difference import save_difference_picture
    from kcal.report.figures import check_picture

    if picture is not None:
        check_picture(picture)
    found = import_cameras(path)
    subject = _subject(path, name)
    done = export_cameras(
        subject if subject is not None else picked(found, name, source), output, format=format, model=model
    )
    for camera, model_name, misfit in zip(
        found.names if subject is not None else [name or found.names[0]], done.models, done.misfits, strict=True
    ):
        label = f"{camera or 'camera'}: {model_name}"
        if misfit is None:
            out.print(f"{label}, {'baked' if done.format == 'remap' else 'exact'}", markup=False)
        else:
            text = f"{label}, fitted: RMS {misfit.rms:.2g} px, at most {misfit.largest:.2g} px over the image"
            out.print(text, markup=False)
    if done.lost:
        out.print(f"not in the file: {', '.join(done.lost)}")
    misfits = [misfit for misfit in done.misfits if misfit is not None]
    if picture is not None and misfits:
        print_wrote(save_difference_picture(picture, max(misfits, key=lambda each: each.largest), title=source))
    elif picture is not None:
        out.print("no picture: nothing was refitted")
    print_wrote(*done.paths)


def _subject(path: Path, name: str | None):  # type: ignore[no-untyped-def]
    """What a file contains as a whole: its rig or its cameras; None where one of them was named."""
    from kcal.io.formats import import_cameras, recognized
    from kcal.io.rig_file import load_rig

    if name is not None:
        return None
    found = import_cameras(path)
    if len(found.cameras) == 1:
        return found.cameras[0]
    if recognized(path) == "kcal":
        return load_rig(path)
    return found.rig() if found.is_rig() else found.cameras


def import_command(
    sources: Annotated[list[Path], typer.Argument(metavar="FILE...", help="File of another program; two of a pair.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="Camera or rig file to write.")],
    format: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="opencv, ros, kalibr, mrcal, colmap, nerfstudio, matlab or opensfm."),
    ] = None,
    camera: Annotated[str | None, typer.Option(metavar="NAME", help="Take this camera of several.")] = None,
    size: Annotated[
        str | None, typer.Option(metavar="WIDTHxHEIGHT", help="Image size, where the file has none.")
    ] = None,
    fisheye: Annotated[
        bool | None, typer.Option("--fisheye/--no-fisheye", help="Whether four coefficients of OpenCV are a fisheye's.")
    ] = None,
    unit: Annotated[
        str | None,
        typer.Option(metavar="UNIT", help="Unit of the translation, where the file has none: mm, cm, m, in."),
    ] = None,
) -> None:
    """Read a camera or a rig from a file of another program.

    The format is recognized. Two cameras with their relative pose become a rig file.

    **Examples**

    `kcal import left.yaml -o left.camera.json`

    `kcal import intrinsics.yml extrinsics.yml --size 640x480 --unit mm -o rig.json`

    `kcal import cameras.txt --camera 2 -o second.camera.json`
    """
    check_writable(output, *sources)
    if unit is not None and unit not in _UNITS:
        raise InputError(f"--unit {unit}: write mm, cm, m or in")

    from kcal.io.camera_file import save_camera
    from kcal.io.formats import import_cameras
    from kcal.io.rig_file import save_rig

    found = import_cameras(
        *sources, format=format, size=parse_size(size), fisheye=fisheye, meters=_UNITS[unit] if unit else None
    )
    for note in found.notes:
        warn(note)
    if camera is None and found.is_rig():
        rig = found.rig()
        save_rig(rig, output)
        out.print(f"rig from {found.format}: baseline {float(rig.baseline):.6g} m", markup=False)
    else:
        chosen = picked(found, camera, " ".join(map(str, sources)))
        save_camera(chosen, output)
        out.print(f"camera from {found.format}: {chosen.model}, {chosen.size[0]}x{chosen.size[1]} px", markup=False)
    out.print("not in the file: error bars, calibration record")
    print_wrote(output)
