"""Night images of the cameras of a rig, for `kcal rig --stars`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from kcal.errors import InputError, KcalError

if TYPE_CHECKING:
    from kcal.calibrate.rig.sources import MeasuredPosition
    from kcal.calibrate.rig.star_source import StarSource
    from kcal.lens.camera import Camera
    from kcal.lens.mounting import Origin
    from kcal.stars.night import NamedStars

# m: how well the place of `--origin` is known to be that of the first camera, along each axis.
_PLACE_SIGMA = 3.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class NightOptions:
    """What the user gave of night images, as on the command line."""

    images: tuple[str, str] | Mapping[str, str]
    time: str | None = None
    clock_sigma: float = 0.1
    drift_sigma: float = 0.05
    celsius: float | None = None
    hectopascal: float | None = None
    dut1: float | None = None


def read_stars(
    cameras: Mapping[str, Camera],
    night: NightOptions,
    origin: Origin | None,
    positions: tuple[MeasuredPosition, ...],
    *,
    placed: bool,
) -> tuple[StarSource, tuple[MeasuredPosition, ...], list[str]]:
    """The stars of all images, the positions with that of the first camera, and lines that say what was found.

    Args:
        cameras: by their names, in order.
        night: what the user gave.
        origin: of the rig's frame; None if nothing is known on the Earth.
        positions: measured ones.
        placed: whether landmarks or anything else places the rig already.
    """
    import torch

    from kcal.calibrate.rig.sources import MeasuredPosition
    from kcal.stars.rig_stars import moments_of, star_source

    given = _images_by_camera(cameras, night.images)
    images = [_named_images(name, given[name], camera, night, origin) if name in given else []
              for name, camera in cameras.items()]  # fmt: skip
    moments, alone = moments_of(images)
    on_earth = all(image.on_earth for own in images for image in own)
    if not any(len(moment) > 1 for moment in moments) and not (on_earth and len(cameras) > 2):
        first, *_, last = cameras
        raise InputError(
            f"--stars: no image of the {first} camera was taken at the time of one of the {last}; "
            "pairs are of one moment"
        )
    if on_earth and not placed and not positions:
        there = torch.zeros(3, dtype=torch.float64)
        positions = (MeasuredPosition(camera=0, point=there, sigma=torch.full_like(there, _PLACE_SIGMA)),)
    frame = origin if placed or positions else None
    source = star_source(
        moments, list(cameras.values()), clock_sigma=night.clock_sigma, drift_sigma=night.drift_sigma, origin=frame
    )
    named = int(source.named.sum())
    lines = [
        f"stars: {len(moments)} moments, {len(source.names)} stars, {named} with a direction on the Earth"
        + (f"; {alone} images without partner" if alone else ""),
        f"clocks of the cameras against each other: ± {night.clock_sigma:g} s, which no residual shows: up to "
        f"{math.degrees(7.292e-5 * night.clock_sigma):.5f}° of relative attitude, and part of every σ below",
    ]
    if any(effect.factor is not None for effect in source.effects):
        lines.append(
            f"their drift: ± {night.drift_sigma:g} s an hour since the night's first images (--clock-drift 0 where GPS "
            "or a network keeps them)"
        )
    if on_earth and night.dut1 is None:
        lines.append("UT1 - UTC is not known (--dut1): 8″ of heading, part of its σ")
    return source, positions, lines


def images_of_nights(pair: tuple[str, str] | None, named: Sequence[str]) -> tuple[str, str] | dict[str, str]:
    """Where night images are: LEFT RIGHT of two cameras, or NAME=IMAGES, one for each of more.

    Raises:
        InputError: both, no name, or a name twice.
    """
    if pair is not None and not named:
        return pair
    found = {}
    for text in named:
        name, equals, images = text.partition("=")
        if pair is not None or not (name and equals and images) or name in found:
            raise InputError(f"--night {text!r}: write NAME=IMAGES, once for each camera, and no --stars")
        found[name] = images
    return found


def _images_by_camera(cameras: Mapping[str, Camera], images: tuple[str, str] | Mapping[str, str]) -> dict[str, str]:
    if isinstance(images, tuple):
        if len(cameras) != 2:
            raise InputError("--stars LEFT RIGHT is for rigs of two cameras; give --night NAME=IMAGES for each")
        return dict(zip(cameras, images, strict=True))
    if not set(images) <= set(cameras):
        raise InputError(f"--night: the cameras are {', '.join(cameras)}, got {', '.join(images)}")
    return dict(images)


def _named_images(
    side: str, given: str, camera: Camera, night: NightOptions, origin: Origin | None
) -> list[NamedStars]:
    from kcal.cli.console import steps, warn
    from kcal.cli.night_images import sky_view
    from kcal.stars.contradictions import clock_doubts
    from kcal.stars.night import name_stars
    from kcal.stars.night_image import expand_nights, read_night

    files = expand_nights([given])
    found: list[NamedStars] = []
    # A place without a time tells nothing.
    place = origin if night.time is not None else None
    where = (None, None, 0.0) if place is None else (place.lat, place.lon, place.height)
    with steps(f"naming stars of {side}", len(files)) as advance:
        for path in files:
            view = sky_view(
                path, night.time, *where, dut1=night.dut1, celsius=night.celsius,
                pressure=night.hectopascal,
            )  # fmt: skip
            try:
                image = name_stars(read_night(path), camera, view)
            except KcalError as error:
                warn(f"{side} {path.name}: {error}; left out")
            else:
                for text in image.warnings:
                    warn(f"{side} {path.name}: {text}")
                found.append(image)
            advance(path.name)
    for number, text in clock_doubts(found):
        warn(f"{side}, image {number + 1} with names: {text}")
    if not found:
        raise InputError(f"--stars: in none of the {len(files)} images of {side} stars have names")
    return found
