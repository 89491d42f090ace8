"""Recognize surveys whose coordinates are exchanged or have the wrong sign: landmarks as in a mirror."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor

from kcal.calibrate.rig.explanations import AS_GOOD
from kcal.calibrate.rig.landmarks import Landmarks
from kcal.calibrate.rig.resection import consensus_pose
from kcal.calibrate.rig.result import RigResult
from kcal.calibrate.rig.solve import RigOptions, solve_rig
from kcal.calibrate.rig.sources import RigData
from kcal.errors import InputError, KcalError
from kcal.finding import Finding
from kcal.lens.rig import Origin
from kcal.locate.geodesy import enu_to_geodetic, geodetic_to_enu
from kcal.locate.mounting import attitude
from kcal.texts import length_text

# Marks of one camera that are needed to tell; degrees of pitch beyond which a roll says nothing of what is upright.
_LEAST, _STEEP = 5, 60.0
# Times the noise that rays may be off, on average, where three of the marks place a camera.
_ROUGHLY = 10.0
# What is wrong: order and signs of the columns that are right.
_EARTH = {
    "latitude and longitude are exchanged": ((1, 0, 2), (1, 1, 1)),
    "latitudes or longitudes have the wrong sign (south and west are negative)": ((0, 1, 2), (1, -1, 1)),
    "heights count downward": ((0, 1, 2), (1, 1, -1)),
}
_LOCAL = {
    "east and north are exchanged, or one of them has the wrong sign": ((1, 0, 2), (1, 1, 1)),
    "up counts downward": ((0, 1, 2), (1, 1, -1)),
    "north and up are exchanged": ((0, 2, 1), (1, 1, 1)),
    "east and up are exchanged": ((2, 1, 0), (1, 1, 1)),
}


def solve_surveyed(
    data: RigData, origin: Origin | None, options: RigOptions, progress: Callable[[str], None] = lambda _: None
) -> RigResult:
    """`solve_rig`, and where landmarks may be surveyed as in a mirror, an error or a warning that says so.

    Raises:
        InputError: landmarks fit only as in a mirror; or see `solve_rig`.
        DegenerateError: see `solve_rig`.
    """
    try:
        found = solve_rig(data, options, progress)
    except KcalError:
        _, text = _like_mirrored(data, origin, None)
        if text:
            raise InputError(text) from None
        raise
    told, text = _like_mirrored(data, origin, found)
    if told:
        raise InputError(text)
    return dataclasses.replace(found, findings=(*found.findings, Finding("swapped", "doubt", text))) if text else found


def _like_mirrored(data: RigData, origin: Origin | None, found: RigResult | None) -> tuple[bool, str]:
    """Whether landmarks fit better as in a mirror, and what is then exchanged; no text where nothing speaks for it.

    A camera cannot tell flat ground from its mirror image: that is seen alike from below by a camera that hangs upside
    down. Landmarks at several heights contradict each other.

    Args:
        data: what a rig was solved from.
        origin: of its frame; None for local meters.
        found: its solution; None where there is none.
    """
    marks = data.landmarks
    if marks is None or marks.effects or data.positions or data.skyline or data.stars:
        return False, ""
    seen = torch.isfinite(marks.pixels).all(-1)
    camera = int(seen.sum(0).argmax())
    if int(seen[:, camera].sum()) < _LEAST:
        return False, ""
    if found is not None and _upright(found, camera) and not found.left_out and found.variance == 1.0:
        return False, ""
    given = _one_camera(data, marks.points, camera)
    if given is not None and _upright(given, 0):
        return False, ""
    ways = {}
    for text, (order, signs) in (_LOCAL if origin is None else _EARTH).items():
        points = _changed(marks.points, origin, list(order), signs)
        mirrored = None if points is None else _one_camera(data, points, camera)
        if mirrored is not None and _upright(mirrored, 0) and (given is None or mirrored.chi2 < given.chi2 + AS_GOOD):
            ways[text] = mirrored
    if not ways:
        return False, ""
    least = min(way.chi2 for way in ways.values())
    text = min((text for text in ways if ways[text].chi2 < least + AS_GOOD), key=lambda text: _tilt(ways[text], 0))
    below = "as given, they contradict each other"
    if given is not None:
        _, _, roll = attitude(given.rotation[0].T)
        below = f"as given, {data.names[camera]} hangs upside down (roll {roll:.0f}°) {_height(given)} them"
    told = given is None or least < given.chi2 - AS_GOOD
    first, last = ("are", "Correct the columns of the survey") if told or found is None else (
        "may be", "Correct the columns of the survey, unless it hangs so: level landmarks do not tell"
    )  # fmt: skip
    return told, (
        f"the landmarks {first} surveyed as in a mirror: {text}; {below}, otherwise they fit and it stands upright "
        f"{_height(ways[text])} them (RMS {ways[text].rms:.2g} px). {last}"
    )


def _one_camera(data: RigData, points: Tensor, camera: int) -> RigResult | None:
    """The solution of one camera from landmarks at these points; None where they contradict each other."""
    marks = data.landmarks
    assert marks is not None
    use = torch.isfinite(marks.pixels[:, camera]).all(-1)
    sigma = torch.as_tensor(marks.pixel_sigma).expand(marks.pixels.shape[:2])[use][:, [camera]]
    names = tuple(name for name, used in zip(marks.names, use.tolist(), strict=True) if used)
    own = Landmarks(
        names=names, points=points[use], sigma=marks.sigma[use], pixels=marks.pixels[use][:, [camera]],
        pixel_sigma=sigma,
    )  # fmt: skip
    # Whether the places can agree is seen at once; only then is it worth solving.
    rays, valid = data.cameras[camera].unproject(own.pixels[:, 0])
    pose = consensus_pose(rays[valid], own.points[valid])
    if pose is None:
        return None
    near = float((own.points - pose[1]).norm(dim=-1).min())
    noise = float(sigma.max()) / float(data.cameras[camera].focal[0].detach()) + float(own.sigma.max()) / near
    if not pose[2] < len(names) * (_ROUGHLY * noise) ** 2:
        return None
    one = RigData(cameras=(data.cameras[camera],), names=(data.names[camera],), landmarks=own)
    try:
        result = solve_rig(one, RigOptions(intrinsics="fixed"))
    except KcalError:
        return None
    return None if result.left_out or result.variance > 1.0 else result


def _changed(points: Tensor, origin: Origin | None, order: list[int], signs: tuple[int, ...]) -> Tensor | None:
    """(N, 3) the places with their coordinates in another order and with other signs; None for no places on Earth."""
    values = points if origin is None else enu_to_geodetic(points, origin)
    values = values[:, order] * torch.tensor(signs, dtype=torch.float64)
    if origin is None:
        return values
    try:
        return geodetic_to_enu(values, Origin.at(values[0]))
    except InputError:
        return None


def _tilt(found: RigResult, camera: int) -> float:
    _, pitch, roll = attitude(found.rotation[camera].T)
    return abs(roll) + abs(pitch)


def _upright(found: RigResult, camera: int) -> bool:
    """Whether a camera is not upside down below the landmarks; where it looks up or down, there is no telling."""
    _, pitch, roll = attitude(found.rotation[camera].T)
    return abs(pitch) > _STEEP or abs(roll) < 90.0 or _over_them(found, camera) > 0.0


def _over_them(found: RigResult, camera: int) -> float:
    assert found.data.landmarks is not None
    return float(found.center[camera, 2] - found.data.landmarks.points[:, 2].mean())


def _height(found: RigResult) -> str:
    above = _over_them(found, 0)
    return f"{length_text(abs(above), digits=2)} {'above' if above > 0 else 'below'}"
