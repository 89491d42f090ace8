"""`kcal show`: what is in a file of kcal or of another program."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kcal.cli.console import out, print_table
from kcal.cli.inputs import SHOWN
from kcal.errors import FileError
from kcal.files import read_bytes
from kcal.strict_json import MOST_BYTES, read_json

if TYPE_CHECKING:
    from kcal.lens.camera import Camera
    from kcal.lens.rig import StereoRig

# Parameters of hybrid lenses that are shown; their hundreds of weights say nothing one by one.
_SHOWN = 26


def show_command(
    file: Annotated[Path, typer.Argument(help="Camera, rig or observations of kcal, or a foreign camera file."), SHOWN],
) -> None:
    """Print what is in a file: cameras with their error bars and history, rigs, observations.

    **Example**

    `kcal show left.camera.json`
    """
    from kcal.io.formats import import_cameras, recognized

    kind = recognized(file)
    if kind != "kcal":
        found = import_cameras(file)
        out.print(f"{file}: {found.format}, {len(found.cameras)} cameras", markup=False)
        for note in found.notes:
            out.print(f"  {note}", markup=False)
        for camera in found.cameras:
            _show_camera(camera)
        if found.is_rig():
            _show_pose(found.rig())
        return
    content = read_json(read_bytes(file, MOST_BYTES), str(file))
    out.print(f"{file}: kcal {content['kcal']} file, version {content.get('version')}", markup=False)
    shown = {"camera": _show_camera_file, "rig": _show_rig_file, "observations": _show_observations}
    if content["kcal"] not in shown:
        raise FileError(f"{file}: kcal show knows camera, rig and observations files, not {content['kcal']} files")
    shown[content["kcal"]](file)


def _show_camera_file(file: Path) -> None:
    from kcal.io.camera_file import load_camera

    _show_camera(load_camera(file))


def _show_rig_file(file: Path) -> None:
    from kcal.io.rig_file import load_rig

    rig = load_rig(file)
    _show_camera(rig.left)
    _show_camera(rig.right)
    _show_pose(rig)


def _show_camera(camera: Camera) -> None:
    known = camera.calibration
    out.print(f"\ncamera {known.name if known and known.name else ''}".rstrip(), markup=False)
    share = "the whole image" if bool(camera.covers_image()) else "part of the image"
    out.print(f"{camera.size[0]}x{camera.size[1]} px, {camera.model}, valid in {share}", markup=False)
    record = known.record if known else None
    if record:
        out.print(
            f"calibrated {record.created:%Y-%m-%d %H:%M %Z} by kcal {record.kcal_version}: RMS {record.rms:.4f} px, "
            f"{record.views} views, {record.points} corners, board {record.board}, {len(record.excluded)} left out",
            markup=False,
        )
        if record.temperature is not None:
            out.print(f"at {record.temperature:g} °C")
    from kcal.lens.paraxial import paraxial_focal

    hybrid = ", on its axis; fx and fy below are parameters of the base projection alone" if camera.model.hybrid else ""
    out.print(f"focal length {paraxial_focal(camera)}{hybrid}", markup=False)
    sigma = _sigmas(camera)
    values = camera.params.detach().tolist()
    rows = [["parameter", "value", "sigma"]]
    for name, value, error in list(zip(camera.names, values, sigma, strict=True))[:_SHOWN]:
        rows.append([name, f"{value:.8g}", "" if error is None else f"{error:.2g}"])
    print_table(rows)
    if len(values) > _SHOWN:
        out.print(f"and {len(values) - _SHOWN} more weights of the field")
    if known is not None and known.covariance is not None:
        from kcal.lens.uncertainty import image_sigma

        spread = image_sigma(camera)
        spread = spread[spread.isfinite()]
        out.print(
            f"sigma in the image: {float(spread.median()):.3g} px (median), {float(spread.max()):.3g} px (largest)"
        )
    else:
        out.print("no error bars")


def _sigmas(camera: Camera) -> list[float | None]:
    known = camera.calibration
    if known is None:
        return [None] * len(camera.names)
    if known.sigma is not None:
        return [known.sigma.get(name) for name in camera.names]
    if known.covariance is None:
        return [None] * len(camera.names)
    return [value**0.5 if value > 0 else None for value in known.covariance.diagonal().tolist()]


def _show_pose(rig: StereoRig) -> None:
    from kcal.lens.pose import vector_from_rotation

    x, y, z = rig.right_from_left_translation.tolist()
    turn = vector_from_rotation(rig.right_from_left_rotation).rad2deg().tolist()
    out.print(f"\nbaseline {float(rig.baseline):.6g} m, translation {x:.6g}, {y:.6g}, {z:.6g} m")
    out.print(f"rotation vector of the right camera {turn[0]:.6g}, {turn[1]:.6g}, {turn[2]:.6g}°")
    if rig.covariance is not None:
        errors = rig.covariance.matrix.diagonal()[-6:].sqrt().tolist()
        out.print(
            f"sigma of it {' '.join(f'{1e3 * e:.3g}' for e in errors[3:])} mm, "
            f"{' '.join(f'{57.29577951 * e:.2g}' for e in errors[:3])}°"
        )
    if rig.mounting is not None:
        place: Any = rig.mounting.origin
        out.print(f"at {place.lat:.7f}, {place.lon:.7f}, {place.height:.2f} m, heading {rig.mounting.heading_deg:.3f}°")
    if rig.calibration is not None:
        record = rig.calibration
        out.print(
            f"solved {record.created:%Y-%m-%d %H:%M %Z}: RMS {record.rms:.4f} px, {record.pairs} pairs", markup=False
        )
        for text in record.warnings:
            out.print(f"warning: {text}", markup=False)


def _show_observations(file: Path) -> None:
    from kcal.corners.observations import Observations

    seen = Observations.load(file)
    counts = [sum(pixel is not None for pixel in view.pixels) for view in seen.views]
    width, height = seen.image_size
    out.print(f"board {seen.board}; images {width}x{height} px; refinement {seen.refinement}", markup=False)
    out.print(f"{len(counts)} views with {sum(counts)} corners, {len(seen.failures)} images without")
    weights = "with" if all(view.covariance is not None for view in seen.views) else "without"
    out.print(f"corners {weights} their own covariances")
    for failure in seen.failures:
        out.print(f"  {failure.name}: {failure.reason}", markup=False)
