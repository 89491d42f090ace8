"""What cameras, rigs and observations are at a glance, as lines and tables: for the screen and for notebooks.

Nothing that this module imports at once loads torch: `kcal show` tells files of kcal by their summaries.
"""

from __future__ import annotations

import datetime
import itertools
import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

from kcal.texts import counted_text, length_text, measured_text, number_text, setting_text

if TYPE_CHECKING:
    from kcal.corners.observations import Observations
    from kcal.io.file_summary import CameraSummary, RigSummary
    from kcal.lens.camera import Camera
    from kcal.lens.rig import Rig

# A line, or rows of cells with the heads first.
Blocks: TypeAlias = "Iterator[str | list[list[str]]]"
# The block of a file, as it is stored, and what is derived of it.
ShownCamera: TypeAlias = "tuple[dict[str, Any], CameraSummary]"
ShownRig: TypeAlias = "tuple[dict[str, Any], RigSummary]"

_INTRINSICS = ("fx", "fy", "cx", "cy", "skew")


def shown_parameters(hybrid: object) -> int:
    """How many parameters are shown: of hybrid lenses not the hundreds of weights, which say nothing one by one."""
    return 8 if hybrid else 26


def rig_blocks(rig: Rig) -> Blocks:
    """Every camera of a rig, and how they stand."""
    if rig.is_pair:
        cameras, pose = derived_rig(rig)
        last = pose_blocks(*pose)
    else:
        cameras = [derived_camera(camera) for camera in rig.each]
        last = itertools.chain([stands(rig)[0]], stations_blocks(rig))
    return itertools.chain(*(camera_blocks(*camera) for camera in cameras), last)


def derived_camera(camera: Camera) -> ShownCamera:
    """A camera as its file has it, and what that does not say."""
    from kcal.io.camera_file import camera_to_file
    from kcal.io.file_summary import CameraSummary

    content = camera_to_file(camera).dump()
    return content, CameraSummary.derived(camera, content)


def derived_rig(rig: Rig) -> tuple[list[ShownCamera], ShownRig]:
    """The same of two cameras, and of how they stand."""
    from kcal.io.file_summary import RigSummary, take_joint_errors
    from kcal.io.rig_file import rig_to_file

    pose = rig_to_file(rig).dump(), RigSummary.made(rig, {})
    take_joint_errors(rig)
    return [derived_camera(rig.left), derived_camera(rig.right)], pose


def _when(record: Mapping[str, Any]) -> str:
    return f"{datetime.datetime.fromisoformat(record['created']):%Y-%m-%d %H:%M %Z}"


def camera_blocks(content: Mapping[str, Any], known: CameraSummary) -> Blocks:
    """A camera: lens, how it was calibrated, parameters with their σ."""
    yield f"\ncamera {content['name']}".rstrip()
    share = "the whole image" if known.covers_image else "part of the image"
    width, height = content["image_size"]
    yield f"{width}x{height} px, {known.model}, valid in {share}"
    if record := content["calibration"]:
        yield (
            f"calibrated {_when(record)} by kcal {record['kcal_version']}: RMS {record['rms']:.4f} px, "
            f"{record['views']} views, {record['points']} corners, board {known.board}, "
            f"{len(record['excluded'])} left out"
        )
        if record.get("without"):
            yield f"without {' and '.join(record['without'])}"
        if record["temperature"] is not None:
            yield f"at {record['temperature']:g} °C"
    if stood := content.get("setting"):
        sources = ", ".join(stood["interpolated_from"])
        yield f"setting {setting_text(stood['values'])}" + (f", interpolated from {sources}" if sources else "")
    hybrid = content["model"].get("hybrid") is not None
    axis = ", on its axis; fx and fy below are parameters of the base projection alone" if hybrid else ""
    yield f"focal length {known.focal_length}{axis}"
    values = {name: content["intrinsics"][name] for name in _INTRINSICS} | content["coefficients"]
    shown = shown_parameters(hybrid)
    rows = [["parameter", "value", "sigma"]]
    for name, value in list(values.items())[:shown]:
        error = known.sigma.get(name)
        rows.append([name, number_text(value, error, digits=8), "" if error is None else number_text(error, error)])
    yield rows
    if len(values) > shown:
        yield f"and {len(values) - shown} weights of the field"
    if known.sigma_px is not None:
        median, largest = known.sigma_px
        yield f"sigma in the image: {median:.3g} px (median), {largest:.3g} px (largest)"
    elif not any(known.sigma.values()):
        yield "no error bars"


def pose_blocks(content: Mapping[str, Any], known: RigSummary) -> Blocks:
    """How two cameras stand, and how that was solved."""
    x, y, z = content["poses"][1]["translation"]
    turn = known.rotation_vector_deg
    yield f"\nbaseline {known.baseline_m:.6g} m, translation {x:.6g}, {y:.6g}, {z:.6g} m"
    yield f"rotation vector of the right camera {turn[0]:.6g}, {turn[1]:.6g}, {turn[2]:.6g}°"
    if known.sigma_m is not None and known.sigma_deg is not None:
        yield (
            f"sigma of it {' '.join(f'{1e3 * error:.3g}' for error in known.sigma_m)} mm, "
            f"{' '.join(f'{error:.2g}' for error in known.sigma_deg)}°"
        )
    if place := content["mounting"]:
        yield (
            f"at {place['lat']:.7f}, {place['lon']:.7f}, {place['height']:.2f} m, heading {place['heading_deg']:.3f}°"
        )
    if record := content["calibration"]:
        yield f"solved {_when(record)}: RMS {record['rms']:.4f} px, {counted_text(record['pairs'], 'pair')}"
        if record.get("pixel_sigma") is not None:
            yield f"noise of marks {record['pixel_sigma']:g} px along each axis"
        if record.get("lens_change"):
            yield f"lenses may have changed by {record['lens_change']:g} px at the image's corner"
        yield from (f"warning: {text}" for text in record["warnings"])


def stations_blocks(rig: Rig) -> Blocks:
    """How any number of cameras were solved; `stands` has how they stand."""
    yield "error bars of cameras and poses together" if rig.root is not None else "no error bars of the poses"
    if (solved := rig.calibration) is not None:
        yield f"solved {solved.created:%Y-%m-%d %H:%M %Z}: RMS {solved.rms:.4f} px"
        if solved.lens_change:
            yield f"lenses may have changed by {solved.lens_change:g} px at the image's corner"
        yield from (f"open: {text}" for text in solved.undetermined)
        yield from (f"warning: {text}" for text in solved.warnings)


def observations_blocks(seen: Observations) -> Blocks:
    """Board, images, and those without a board."""
    counts = [int(view.seen.sum()) for view in seen.views]
    width, height = seen.image_size
    yield f"board {seen.board}; images {width}x{height} px; refinement {seen.refinement}"
    without = counted_text(len(seen.failures), "image")
    yield f"{counted_text(len(counts), 'view')} with {sum(counts)} corners, {without} without"
    weights = "with" if all(view.covariance is not None for view in seen.views) else "without"
    yield f"corners {weights} their own covariances"
    yield from (f"  {failure.name}: {failure.reason}" for failure in seen.failures)


def stands(rig: Rig) -> tuple[list[list[str]], dict[str, dict[str, float]]]:
    """How each camera stands, with error bars, on the Earth or in the rig's own frame: as rows, and for programs."""
    import torch

    from kcal.locate.stations import station_stands

    axes, heads, digits = ("east_m", "north_m", "up_m"), ["east m", "north m", "up m"], (3, 3, 3)
    if rig.origin:
        axes, heads, digits = ("lat", "lon", "height"), ["lat", "lon", "height m"], (7, 7, 2)
    # The frame of the first camera has no north.
    own = not rig.origin and torch.equal(rig.rotation[0], torch.eye(3).to(rig.rotation))
    heads = ["x m", "y m", "z m"] if own else [*heads, "± level", "± up", "heading °", "pitch °", "roll °"]
    rows, told = [["camera", "RMS px", *heads]], {}
    residuals = rig.calibration.rms_px if rig.calibration else (None,) * len(rig)
    for c, (name, residual) in enumerate(zip(rig.names, residuals, strict=True)):
        place, angles, covariance = station_stands(rig, c)
        told[name] = dict(zip((*axes, "heading_deg", "pitch_deg", "roll_deg"), (*place, *angles), strict=True))
        where = [f"{value:.{many}f}" for value, many in zip(place, digits, strict=True)]
        how = ["", "", *(f"{angle:.4f}" for angle in angles)]
        if rig.root is not None and covariance is not None:
            sigma = covariance.diagonal().sqrt().tolist()
            told[name] |= {"sigma_m": max(sigma[:3]), "sigma_deg": math.degrees(max(sigma[3:6]))}
            if not own:
                where[2] = number_text(place[2], sigma[2])
            if not own and not rig.origin:
                where[:2] = map(number_text, place[:2], sigma[:2])
            how = [
                length_text(max(sigma[:2]), digits=2), length_text(sigma[2], digits=2),
                *(measured_text(angle, math.degrees(error)) for angle, error in zip(angles, sigma[3:], strict=True)),
            ]  # fmt: skip
        rms = "" if residual is None else f"{residual:.3f}"
        rows.append([name, rms, *where, *([] if own else how)])
    return rows, told
