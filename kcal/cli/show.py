"""`kcal show`: what is in a file of kcal or of another program.

Files of kcal have a summary of what would have to be computed, so that they are shown without loading torch.
"""

from __future__ import annotations

import datetime
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, TypeVar

import pydantic

import kcal
from kcal.cli.console import out, print_table
from kcal.cli.inputs import SHOWN
from kcal.cli.stations import print_stands
from kcal.errors import FileError
from kcal.file_kind import file_kind
from kcal.files import read_bytes
from kcal.native_file import digest
from kcal.strict_json import MOST_BYTES, read_json
from kcal.texts import number_text, setting_text

if TYPE_CHECKING:
    from kcal.io.file_summary import CameraSummary, RigSummary

# The block of a file, as it is stored, and what is derived of it.
_Camera: TypeAlias = "tuple[dict[str, Any], CameraSummary]"
_Rig: TypeAlias = "tuple[dict[str, Any], RigSummary]"
_Summary = TypeVar("_Summary", bound=pydantic.BaseModel)

# Parameters that are shown: of hybrid lenses those before the hundreds of weights, which say nothing one by one.
_SHOWN, _SHOWN_HYBRID = 26, 8
_INTRINSICS = ("fx", "fy", "cx", "cy", "skew")


def show_command(file: Annotated[Path, SHOWN]) -> None:
    """Print what is in a file: cameras with their error bars and history, rigs, observations.

    **Example**

    `kcal show left.camera.json`

    Args:
        file: Camera, rig or observations of kcal, or a foreign camera file.
    """
    if file_kind(file) not in ("camera", "rig", "observations"):
        _show_foreign(file)
        return
    content = read_json(read_bytes(file, MOST_BYTES), str(file))
    out.print(f"{file}: kcal {content['kcal']} file, version {content.get('version')}")
    if content["kcal"] == "observations":
        _show_observations(file)
        return
    if content["kcal"] == "rig" and (content.get("origin") or len(content.get("names") or "12") != 2):
        _show_stations(file)
        return
    cameras, rig = _as_written(content) or _computed_anew(file, content["kcal"])
    for camera in cameras:
        _show_camera(*camera)
    if rig is not None:
        _show_pose(*rig)


def _show_foreign(file: Path) -> None:
    from kcal.io.formats import recognized

    if recognized(file) == "kcal":
        kind = file_kind(file)
        raise FileError(f"{file}: kcal show knows camera, rig and observations files, not {kind} files")
    found = kcal.lens.import_cameras(file)
    out.print(f"{file}: {found.format}, {len(found.cameras)} cameras")
    for note in found.notes:
        out.print(f"  {note}")
    for camera in found.cameras:
        _show_camera(*_derived_camera(camera))
    if found.is_rig() and (pose := _derived_rig(found.rig())[1]) is not None:
        _show_pose(*pose)


def _as_written(content: dict[str, Any]) -> tuple[list[_Camera], _Rig | None] | None:
    """Blocks of a file with their summaries; None where it has none, or was changed after they were written."""
    from kcal.io.file_summary import CameraSummary, RigSummary

    def checked(kind: type[_Summary], summary: Any) -> _Summary:
        return kind.model_validate_json(json.dumps(summary), strict=True)

    try:
        rig, blocks, summaries = None, [content], [content["summary"]]
        if content["kcal"] == "rig":
            rig = content, checked(RigSummary, content["summary"])
            # The rig knows more of its cameras than each of them knew before it was solved.
            blocks, summaries = content["cameras"], content["summary"]["cameras"]
        cameras = [(block, checked(CameraSummary, known)) for block, known in zip(blocks, summaries, strict=True)]
        own = {key: value for key, value in content.items() if key != "cameras"}
        fresh = (rig is None or rig[1].of == digest(own)) and all(
            known.of == digest(block) and (known.board is None) == (block["calibration"] is None)
            for block, known in cameras
        )
        return (cameras, rig) if fresh else None
    except (KeyError, TypeError, AttributeError, ValueError):
        # No such file was written by kcal: its reader says what is wrong.
        return None


def _computed_anew(file: Path, kind: str) -> tuple[list[_Camera], _Rig | None]:
    if kind == "camera":
        return [_derived_camera(kcal.load_camera(file))], None

    return _derived_rig(kcal.load_rig(file))


def _derived_camera(camera: kcal.Camera) -> _Camera:
    from kcal.io.camera_file import camera_to_file
    from kcal.io.file_summary import CameraSummary

    content = camera_to_file(camera).dump()
    return content, CameraSummary.derived(camera, content)


def _derived_rig(rig: kcal.Rig) -> tuple[list[_Camera], _Rig]:
    from kcal.io.file_summary import RigSummary, take_joint_errors
    from kcal.io.rig_file import rig_to_file

    pose = rig_to_file(rig).dump(), RigSummary.made(rig, {})
    take_joint_errors(rig)
    return [_derived_camera(rig.left), _derived_camera(rig.right)], pose


def _when(record: Mapping[str, Any]) -> str:
    return f"{datetime.datetime.fromisoformat(record['created']):%Y-%m-%d %H:%M %Z}"


def _show_camera(content: Mapping[str, Any], known: CameraSummary) -> None:
    out.print(f"\ncamera {content['name']}".rstrip())
    share = "the whole image" if known.covers_image else "part of the image"
    width, height = content["image_size"]
    out.print(f"{width}x{height} px, {known.model}, valid in {share}")
    if record := content["calibration"]:
        out.print(
            f"calibrated {_when(record)} by kcal {record['kcal_version']}: RMS {record['rms']:.4f} px, "
            f"{record['views']} views, {record['points']} corners, board {known.board}, "
            f"{len(record['excluded'])} left out"
        )
        if record["temperature"] is not None:
            out.print(f"at {record['temperature']:g} °C")
    if stood := content.get("setting"):
        sources = ", ".join(stood["interpolated_from"])
        out.print(f"setting {setting_text(stood['values'])}" + (f", interpolated from {sources}" if sources else ""))
    hybrid = content["model"].get("hybrid") is not None
    axis = ", on its axis; fx and fy below are parameters of the base projection alone" if hybrid else ""
    out.print(f"focal length {known.focal_length}{axis}")
    values = {name: content["intrinsics"][name] for name in _INTRINSICS} | content["coefficients"]
    shown = _SHOWN_HYBRID if hybrid else _SHOWN
    rows = [["parameter", "value", "sigma"]]
    for name, value in list(values.items())[:shown]:
        error = known.sigma.get(name)
        rows.append([name, number_text(value, error, digits=8), "" if error is None else number_text(error, error)])
    print_table(rows)
    if len(values) > shown:
        out.print(f"and {len(values) - shown} weights of the field")
    if known.sigma_px is not None:
        median, largest = known.sigma_px
        out.print(f"sigma in the image: {median:.3g} px (median), {largest:.3g} px (largest)")
    elif not any(known.sigma.values()):
        out.print("no error bars")


def _show_pose(content: Mapping[str, Any], known: RigSummary) -> None:
    x, y, z = content["poses"][1]["translation"]
    turn = known.rotation_vector_deg
    out.print(f"\nbaseline {known.baseline_m:.6g} m, translation {x:.6g}, {y:.6g}, {z:.6g} m")
    out.print(f"rotation vector of the right camera {turn[0]:.6g}, {turn[1]:.6g}, {turn[2]:.6g}°")
    if known.sigma_m is not None and known.sigma_deg is not None:
        out.print(
            f"sigma of it {' '.join(f'{1e3 * error:.3g}' for error in known.sigma_m)} mm, "
            f"{' '.join(f'{error:.2g}' for error in known.sigma_deg)}°"
        )
    if place := content["mounting"]:
        out.print(
            f"at {place['lat']:.7f}, {place['lon']:.7f}, {place['height']:.2f} m, heading {place['heading_deg']:.3f}°"
        )
    if record := content["calibration"]:
        out.print(f"solved {_when(record)}: RMS {record['rms']:.4f} px, {record['pairs']} pairs")
        if record.get("pixel_sigma") is not None:
            out.print(f"noise of marks {record['pixel_sigma']:g} px along each axis")
        for text in record["warnings"]:
            out.print(f"warning: {text}")


def _show_stations(file: Path) -> None:

    rig = kcal.load_rig(file)
    for camera in rig.each:
        _show_camera(*_derived_camera(camera))
    out.print("")
    print_stands(rig)
    out.print("error bars of cameras and poses together" if rig.root is not None else "no error bars of the poses")
    if (solved := rig.calibration) is not None:
        out.print(f"solved {solved.created:%Y-%m-%d %H:%M %Z}: RMS {solved.rms:.4f} px")
        for text in solved.undetermined:
            out.print(f"open: {text}")
        for text in solved.warnings:
            out.print(f"warning: {text}")


def _show_observations(file: Path) -> None:

    seen = kcal.Observations.load(file)
    counts = [sum(pixel is not None for pixel in view.pixels) for view in seen.views]
    width, height = seen.image_size
    out.print(f"board {seen.board}; images {width}x{height} px; refinement {seen.refinement}")
    out.print(f"{len(counts)} views with {sum(counts)} corners, {len(seen.failures)} images without")
    weights = "with" if all(view.covariance is not None for view in seen.views) else "without"
    out.print(f"corners {weights} their own covariances")
    for failure in seen.failures:
        out.print(f"  {failure.name}: {failure.reason}")
