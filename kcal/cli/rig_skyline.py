"""A terrain raster and images of the skyline, for `kcal rig --skyline` and `kcal station --skyline`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from kcal.errors import InputError

if TYPE_CHECKING:
    from kcal.calibrate.rig.skyline_source import SkylineSource
    from kcal.calibrate.rig.sources import MeasuredPosition
    from kcal.lens.camera import Camera
    from kcal.lens.mounting import Origin
    from kcal.skyline.attitude import SkylineAttitude
    from kcal.skyline.raster_error import RasterError
    from kcal.skyline.rig_skyline import SkylineImage

SKYLINE_HELP = (
    "Raster of terrain heights (GeoTIFF or .asc), with --skyline-images and --positions: the skyline tells how the "
    "cameras look on the Earth, heading included."
)
IMAGES_HELP = "Images of the skyline by a camera: file, folder or quoted wildcard; once for each camera."
SIGMA_HELP = "Of a height of the --skyline raster; 2 is a 30 m raster from satellites, 0.3 one from lidar."
PICTURE_HELP = "A .png or .svg file: the raster's skyline over each image, and what is left."


@dataclasses.dataclass(frozen=True, kw_only=True)
class SkylineOptions:
    """What the user gave of skylines, as on the command line.

    Args:
        raster: file of heights.
        images: of each camera, by its name; "" for the only one.
        geoid: meters added to the raster's heights.
        error: of these, and of refraction.
        picture: file to draw the fit to.
    """

    raster: Path
    images: Mapping[str, str]
    geoid: float
    error: RasterError
    picture: Path | None = None


def skyline_options(
    raster: Path | None, images: Sequence[str], scene: tuple[str, str] | None, geoid: float | None,
    sigma: float | None, refraction: tuple[float, float], picture: Path | None,
) -> SkylineOptions | None:  # fmt: skip
    """Check the options; without images of their own, those of `--scene` are taken.

    Raises:
        InputError: images without a raster or the other way round, or a camera twice.
    """
    from kcal.files import check_picture
    from kcal.skyline.raster_error import RasterError

    if raster is None:
        if images or picture is not None:
            raise InputError("--skyline-images and --skyline-picture need the raster of the terrain: --skyline DEM.tif")
        return None
    found: dict[str, str] = {}
    for text in images:
        name, equals, given = text.partition("=")
        if not equals:
            name, given = "", text
        if name in found:
            raise InputError(f"--skyline-images {text!r}: give NAME=IMAGES once for each camera")
        found[name] = given
    if not found and scene is not None:
        found = dict(zip(("left", "right"), scene, strict=True))
    if not found:
        raise InputError("--skyline needs images: --skyline-images IMAGES, or NAME=IMAGES once for each camera")
    if picture is not None:
        check_picture(picture)
    known = {} if sigma is None else {"sigma": sigma, "offset": 0.5 * sigma}
    error = RasterError(refraction=refraction[0], refraction_sigma=refraction[1], **known)
    return SkylineOptions(raster=raster, images=found, geoid=geoid or 0.0, error=error, picture=picture)


def read_skyline(
    cameras: Mapping[str, Camera], given: SkylineOptions, origin: Origin | None, positions: Sequence[MeasuredPosition]
) -> tuple[SkylineSource, list[str]]:
    """What the skylines tell, and lines that say what was found.

    Args:
        cameras: by their names, in order.
        given: what the user gave.
        origin: of the rig's frame.
        positions: measured ones, of all cameras with images.

    Raises:
        InputError: a camera without a place, and what `skyline_source` refuses.
    """
    import torch

    from kcal.cli.console import steps, warn
    from kcal.locate.raster import terrain
    from kcal.skyline.rig_skyline import skyline_source

    names = list(cameras)
    images = _read_images(names, given.images)
    places = {position.camera: position for position in positions}
    without = sorted({names[image.camera] for image in images if image.camera not in places})
    if origin is None or without:
        raise InputError(
            f"--skyline needs the place of {' and '.join(without) or 'each camera'} on the Earth: measure it (GNSS) "
            f"and give --position{'s' * (len(names) > 1)} with latitudes and longitudes (or with local meters and "
            "--origin)"
        )
    centers, sigma = torch.zeros(len(names), 3).double(), torch.ones(len(names), 3).double()
    for number, position in places.items():
        centers[number], sigma[number] = position.point, position.sigma
    with steps("comparing skylines with the terrain", None):
        raster = terrain(given.raster, given.geoid)
        source, found = skyline_source(
            images, list(cameras.values()), raster, origin, centers, sigma, error=given.error
        )
    if given.picture is not None:
        from kcal.report.skyline import save_skyline_picture

        save_skyline_picture(given.picture, [(image.name, image.image) for image in images], found)
    lines = [line for image, one in zip(images, found, strict=True) for line in _lines(image, names, one)]
    for image, one in zip(images, found, strict=True):
        for text in one.warnings:
            warn(f"skyline {image.name}: {text}")
    return source, lines


def _read_images(names: Sequence[str], given: Mapping[str, str]) -> list[SkylineImage]:
    from kcal.corners.images import expand_images, read_gray
    from kcal.skyline.rig_skyline import SkylineImage

    if "" in given and len(names) == 1:
        given = {names[0]: given[""]}
    unknown = [name for name in given if name not in names]
    if unknown:
        raise InputError(
            f"--skyline-images {unknown[0] or given[unknown[0]]}: write NAME=IMAGES; the cameras are {', '.join(names)}"
        )
    return [
        SkylineImage(name=f"{name} {path.name}", camera=names.index(name), image=read_gray(path))
        for name, text in given.items()
        for path in expand_images([text])
    ]


def _lines(image: SkylineImage, names: Sequence[str], found: SkylineAttitude) -> list[str]:
    heading, pitch, roll = found.sigma_deg.tolist()
    shares = ", ".join(f"{name} {100 * share[0]:.0f} %" for name, share in found.shares.items() if share[0] > 0.005)
    second = "" if math.isnan(found.second_deg) else (
        f"; next best heading {found.second_deg:.1f}° (χ² larger by {found.second_worse:.0f})"
    )  # fmt: skip
    return [
        f"skyline {image.name}: heading {found.heading_deg:.4f} ± {heading:.4f}°, pitch {found.pitch_deg:.4f} ± "
        f"{pitch:.4f}°, roll {found.roll_deg:.4f} ± {roll:.4f}° by this image alone; {int(found.used.sum())} of "
        f"{len(found.used)} columns{second}",
        f"  variance of its heading: {shares}",
    ]
