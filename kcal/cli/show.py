"""`kcal show`: what is in a file of kcal or of another program.

Files of kcal have a summary of what would have to be computed, so that they are shown without loading torch.
"""

from __future__ import annotations

import dataclasses
import datetime
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import pydantic
import typer

from kcal.cli.console import out, print_table
from kcal.cli.inputs import SHOWN
from kcal.cli.stations import station_rows
from kcal.errors import FileError
from kcal.file_kind import CAMERA_RIG_VERSION, file_kind
from kcal.files import read_bytes
from kcal.native_file import digest
from kcal.strict_json import MOST_BYTES, read_json
from kcal.texts import number_text, setting_text

if TYPE_CHECKING:
    from kcal.lens.camera import Camera
    from kcal.lens.rig import StereoRig

# Parameters of hybrid lenses that are shown; their hundreds of weights say nothing one by one.
_SHOWN = 26
_INTRINSICS = ("fx", "fy", "cx", "cy", "skew")


@dataclasses.dataclass(frozen=True, kw_only=True)
class _CameraFacts:
    """What is shown of a camera: from its file, or computed."""

    name: str
    size: tuple[int, int]
    model: str
    covers_image: bool
    hybrid: bool
    focal_length: str
    values: Mapping[str, float]
    sigma: Mapping[str, float | None]
    sigma_px: tuple[float, float] | None
    record: Mapping[str, Any] | None
    setting: Mapping[str, Any] | None


@dataclasses.dataclass(frozen=True, kw_only=True)
class _PoseFacts:
    """What is shown of the relative pose of a rig."""

    baseline: float
    translation: tuple[float, ...]
    turn: tuple[float, ...]
    sigma_m: tuple[float, ...] | None
    sigma_deg: tuple[float, ...] | None
    mounting: Mapping[str, Any] | None
    record: Mapping[str, Any] | None


def show_command(
    file: Annotated[Path, typer.Argument(help="Camera, rig or observations of kcal, or a foreign camera file."), SHOWN],
) -> None:
    """Print what is in a file: cameras with their error bars and history, rigs, observations.

    **Example**

    `kcal show left.camera.json`
    """
    if file_kind(file) not in ("camera", "rig", "observations"):
        _show_foreign(file)
        return
    content = read_json(read_bytes(file, MOST_BYTES), str(file))
    out.print(f"{file}: kcal {content['kcal']} file, version {content.get('version')}", markup=False)
    if content["kcal"] == "observations":
        _show_observations(file)
        return
    if content["kcal"] == "rig" and content.get("version") == CAMERA_RIG_VERSION:
        _show_stations(file)
        return
    cameras, pose = _stored_facts(content) or _computed(file, content["kcal"])
    for camera in cameras:
        _show_camera(camera)
    if pose is not None:
        _show_pose(pose)


def _show_foreign(file: Path) -> None:
    from kcal.io.formats import import_cameras, recognized

    if recognized(file) == "kcal":
        kind = file_kind(file)
        raise FileError(f"{file}: kcal show knows camera, rig and observations files, not {kind} files")
    found = import_cameras(file)
    out.print(f"{file}: {found.format}, {len(found.cameras)} cameras", markup=False)
    for note in found.notes:
        out.print(f"  {note}", markup=False)
    for camera in found.cameras:
        _show_camera(_facts_of(camera))
    if found.is_rig():
        _show_pose(_pose_of(found.rig()))


def _stored_facts(content: dict[str, Any]) -> tuple[list[_CameraFacts], _PoseFacts | None] | None:
    """What a file says of itself; None where it has no summary, or was changed after that was written."""
    from kcal.io.file_summary import RigSummary

    try:
        if content["kcal"] == "camera":
            camera = _stored_camera(content, content["summary"])
            return None if camera is None else ([camera], None)
        brief = RigSummary.model_validate_json(json.dumps(content["summary"]), strict=True)
        rest = {key: value for key, value in content.items() if key not in ("left", "right")}
        # The rig knows more of its cameras than each of them knew before it was solved.
        cameras = [_stored_camera(content[side], content["summary"][side]) for side in ("left", "right")]
        if brief.of != digest(rest) or None in cameras:
            return None
        pose = _PoseFacts(
            baseline=brief.baseline_m,
            translation=content["right_from_left"]["translation"],
            turn=brief.rotation_vector_deg,
            sigma_m=brief.sigma_m,
            sigma_deg=brief.sigma_deg,
            mounting=content["mounting"],
            record=content["calibration"],
        )
        return [camera for camera in cameras if camera is not None], pose
    except (KeyError, TypeError, AttributeError, pydantic.ValidationError):
        # No such file was written by kcal: its reader says what is wrong.
        return None


def _stored_camera(content: dict[str, Any], summary: Any) -> _CameraFacts | None:
    from kcal.io.file_summary import CameraSummary

    brief = CameraSummary.model_validate_json(json.dumps(summary), strict=True)
    record = content["calibration"]
    if brief.of != digest(content) or (brief.board is None) != (record is None):
        return None
    return _CameraFacts(
        name=content["name"],
        size=content["image_size"],
        model=brief.model,
        covers_image=brief.covers_image,
        hybrid=content["model"].get("hybrid") is not None,
        focal_length=brief.focal_length,
        values={name: content["intrinsics"][name] for name in _INTRINSICS} | content["coefficients"],
        sigma=brief.sigma,
        sigma_px=brief.sigma_px,
        record=record and record | {"board": brief.board},
        setting=content.get("setting"),
    )


def _computed(file: Path, kind: str) -> tuple[list[_CameraFacts], _PoseFacts | None]:
    if kind == "camera":
        from kcal.io.camera_file import load_camera

        return [_facts_of(load_camera(file))], None
    from kcal.io.file_summary import take_joint_errors
    from kcal.io.rig_file import load_rig

    rig = load_rig(file)
    take_joint_errors(rig)
    return [_facts_of(rig.left), _facts_of(rig.right)], _pose_of(rig)


def _facts_of(camera: Camera) -> _CameraFacts:
    from kcal.io.file_summary import sigma_of, sigma_over_image
    from kcal.lens.paraxial import paraxial_focal

    known = camera.calibration
    return _CameraFacts(
        name=known.name if known else "",
        size=camera.size,
        model=str(camera.model),
        covers_image=bool(camera.covers_image()),
        hybrid=camera.model.hybrid is not None,
        focal_length=str(paraxial_focal(camera)),
        values=dict(zip(camera.names, camera.params.detach().tolist(), strict=True)),
        sigma=sigma_of(camera),
        sigma_px=sigma_over_image(camera),
        record=_fields(known.record) if known else None,
        setting=_fields(known.setting) if known else None,
    )


def _pose_of(rig: StereoRig) -> _PoseFacts:
    from kcal.io.file_summary import RigSummary

    brief = RigSummary.made(rig, {})
    mounting = None
    if rig.mounting is not None:
        mounting = {**dataclasses.asdict(rig.mounting.origin), "heading_deg": rig.mounting.heading_deg}
    return _PoseFacts(
        baseline=brief.baseline_m,
        translation=tuple(rig.right_from_left_translation.tolist()),
        turn=brief.rotation_vector_deg,
        sigma_m=brief.sigma_m,
        sigma_deg=brief.sigma_deg,
        mounting=mounting,
        record=_fields(rig.calibration),
    )


def _fields(record: Any) -> dict[str, Any] | None:
    return None if record is None else {each.name: getattr(record, each.name) for each in dataclasses.fields(record)}


def _when(record: Mapping[str, Any]) -> str:
    created = record["created"]
    moment = datetime.datetime.fromisoformat(created) if isinstance(created, str) else created
    return f"{moment:%Y-%m-%d %H:%M %Z}"


def _show_camera(camera: _CameraFacts) -> None:
    out.print(f"\ncamera {camera.name}".rstrip(), markup=False)
    share = "the whole image" if camera.covers_image else "part of the image"
    out.print(f"{camera.size[0]}x{camera.size[1]} px, {camera.model}, valid in {share}", markup=False)
    if record := camera.record:
        out.print(
            f"calibrated {_when(record)} by kcal {record['kcal_version']}: RMS {record['rms']:.4f} px, "
            f"{record['views']} views, {record['points']} corners, board {record['board']}, "
            f"{len(record['excluded'])} left out",
            markup=False,
        )
        if record["temperature"] is not None:
            out.print(f"at {record['temperature']:g} °C")
    if stood := camera.setting:
        sources = ", ".join(stood["interpolated_from"])
        out.print(
            f"setting {setting_text(stood['values'])}" + (f", interpolated from {sources}" if sources else ""),
            markup=False,
        )
    hybrid = ", on its axis; fx and fy below are parameters of the base projection alone" if camera.hybrid else ""
    out.print(f"focal length {camera.focal_length}{hybrid}", markup=False)
    rows = [["parameter", "value", "sigma"]]
    for name, value in list(camera.values.items())[:_SHOWN]:
        error = camera.sigma.get(name)
        rows.append([name, number_text(value, error, digits=8), "" if error is None else number_text(error, error)])
    print_table(rows)
    if len(camera.values) > _SHOWN:
        out.print(f"and {len(camera.values) - _SHOWN} more weights of the field")
    if camera.sigma_px is not None:
        median, largest = camera.sigma_px
        out.print(f"sigma in the image: {median:.3g} px (median), {largest:.3g} px (largest)")
    elif not any(camera.sigma.values()):
        out.print("no error bars")


def _show_pose(pose: _PoseFacts) -> None:
    x, y, z = pose.translation
    turn = pose.turn
    out.print(f"\nbaseline {pose.baseline:.6g} m, translation {x:.6g}, {y:.6g}, {z:.6g} m")
    out.print(f"rotation vector of the right camera {turn[0]:.6g}, {turn[1]:.6g}, {turn[2]:.6g}°")
    if pose.sigma_m is not None and pose.sigma_deg is not None:
        out.print(
            f"sigma of it {' '.join(f'{1e3 * error:.3g}' for error in pose.sigma_m)} mm, "
            f"{' '.join(f'{error:.2g}' for error in pose.sigma_deg)}°"
        )
    if place := pose.mounting:
        out.print(
            f"at {place['lat']:.7f}, {place['lon']:.7f}, {place['height']:.2f} m, heading {place['heading_deg']:.3f}°"
        )
    if record := pose.record:
        out.print(f"solved {_when(record)}: RMS {record['rms']:.4f} px, {record['pairs']} pairs", markup=False)
        if record.get("pixel_sigma") is not None:
            out.print(f"noise of marks {record['pixel_sigma']:g} px along each axis")
        for text in record["warnings"]:
            out.print(f"warning: {text}", markup=False)


def _show_stations(file: Path) -> None:
    from kcal.io.camera_rig_file import CameraRigFile

    rig = CameraRigFile.load(file).rig()
    for camera in rig.each:
        _show_camera(_facts_of(camera))
    out.print("")
    print_table(station_rows(rig))
    out.print("error bars of cameras and poses together" if rig.root is not None else "no error bars of the poses")
    if (solved := rig.calibration) is not None:
        out.print(f"solved {_when({'created': solved.created})}: RMS {solved.rms:.4f} px", markup=False)
        for text in solved.undetermined:
            out.print(f"open: {text}", markup=False)
        for text in solved.warnings:
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
