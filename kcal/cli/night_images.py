"""Night images as commands read them: when and where they were taken, and the lens that their stars tell."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from kcal.cli.console import steps
from kcal.errors import InputError, KcalError

if TYPE_CHECKING:
    from kcal.calibrate.camera.result import CameraCalibrationResult
    from kcal.stars.detect import DetectedStars
    from kcal.stars.lens import StarCamera
    from kcal.stars.night import SkyView

TIME_HELP = "When, with its zone: 2026-11-24T20:47:26Z; name:Z or name:+02:00 reads it from each file's name."


def sky_view(
    path: Path,
    time: str | None,
    lat: float | None,
    lon: float | None,
    height: float,
    *,
    dut1: float | None = None,
    time_sigma: float = 0.1,
    celsius: float | None = None,
    pressure: float | None = None,
) -> SkyView:
    """When and where an image was taken, from options of the command line."""
    from kcal.lens.mounting import Origin
    from kcal.stars.night import SkyView
    from kcal.stars.night_image import time_of
    from kcal.stars.sky import Air

    if (lat is None) != (lon is None):
        raise InputError("--lat and --lon belong together")
    origin = None if lat is None or lon is None else Origin(lat=lat, lon=lon, height=height)
    known = {} if celsius is None else {"celsius": celsius, "celsius_sigma": 1.0}
    known |= {} if pressure is None else {"hectopascal": pressure, "hectopascal_sigma": 1.0}
    air = None if origin is None else Air.at_height(origin.height, **known)
    return SkyView(time=time_of(time, path), origin=origin, air=air, dut1=dut1, time_sigma=time_sigma)


def camera_by_stars(
    files: list[Path], views: list[SkyView], what: str, boards: CameraCalibrationResult | None = None
) -> tuple[StarCamera, tuple[int, int]]:
    """The camera of night images, and of what boards said of it before; and the images' size."""
    from kcal.stars.detect import detect_stars
    from kcal.stars.lens import calibrate_by_stars
    from kcal.stars.night_image import read_night

    stars: list[DetectedStars] = []
    sizes = set()
    with steps("finding stars", len(files)) as advance:
        for path in files:
            try:
                image = read_night(path)
                stars.append(detect_stars(image))
            except KcalError as error:
                raise InputError(f"{path.name}: {error}") from error
            sizes.add((image.shape[1], image.shape[0]))
            advance(path.name)
    if len(sizes) > 1:
        raise InputError(f"the images have several sizes ({sorted(sizes)}): one camera has one")
    (size,) = sizes
    with steps(what, None) as advance:
        return calibrate_by_stars(stars, views, size, boards=boards, progress=advance), size
