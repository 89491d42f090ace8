"""`kcal calibrate --stars`: a camera at infinity from night images alone."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kcal.cli.console import out, print_wrote, steps, tell, warn
from kcal.errors import InputError, KcalError
from kcal.files import check_writable

if TYPE_CHECKING:
    from kcal.stars.detect import DetectedStars
    from kcal.stars.lens import StarCamera
    from kcal.stars.night import SkyView

# Parts of the image, across and down, whose stars are counted for the advice.
_PARTS = 3
_FEW_IN_A_PART = 3


def by_night(
    images: list[str] | None,
    observations: list[Path] | None,
    time: str | None,
    place: str | None,
    output: Path,
    name: str,
) -> None:
    """What `kcal calibrate` does where stars are given, or nothing at all."""
    from kcal.lens.mounting import Origin

    if not images:
        raise InputError("give observations of a board (from `kcal detect`), or night images with --stars")
    if observations:
        raise InputError(
            "boards and stars are not calibrated together yet: calibrate by one of them, and compare the two cameras "
            "with `kcal diff`"
        )
    origin = None if place is None else Origin.parse(place)
    if origin is not None and time is None:
        raise InputError("--place without --time tells nothing: refraction depends on both")
    where = None if origin is None else (origin.lat, origin.lon, origin.height)
    calibrate_by_night(images, time, where, output, name)


def calibrate_by_night(
    images: list[str], time: str | None, place: tuple[float, float, float] | None, output: Path, name: str
) -> None:
    """Calibrate a camera from the stars of night images, and write it.

    Args:
        images: files, folders and wildcards.
        time: as `--time`.
        place: latitude, longitude and height, for refraction; None: not known.
        output: camera file.
        name: of the camera.
    """
    from kcal.io.camera_file import save_camera
    from kcal.stars.night_image import expand_nights

    files = expand_nights(images)
    check_writable(output, *files)
    from kcal.cli.stars import sky_view

    where: tuple[Any, Any, float] = (None, None, 0.0) if place is None else place
    found, size = calibrated(files, [sky_view(path, time, *where) for path in files], "calibrating by stars")
    camera = found.lens.camera
    if camera.calibration is not None and name:
        import dataclasses

        camera.calibration = dataclasses.replace(camera.calibration, name=name)
    save_camera(camera, output)
    count = sum(int(use.sum()) for use in found.lens.used)
    left_out = sum(len(use) for use in found.lens.used) - count
    tell(
        images={files[number].name: len(star) for number, star in zip(found.images, found.stars, strict=True)},
        refused={files[number].name: why for number, why in found.refused.items()},
        stars=count, left_out=left_out, rms_px=found.lens.rms_px, effective=found.lens.effective,
    )  # fmt: skip
    out.print(
        f"{count} stars of {len(found.images)} images, {left_out} left out; RMS [bold]{found.lens.rms_px:.4f} px[/] "
        f"along an axis; f {float(camera.params[0]):.2f} px; the stars determine {found.lens.effective:.1f} unknowns "
        "of the lens"
    )
    out.print("at infinity, without an entrance pupil: for what is farther than some hundred pupil movements")
    for number, why in found.refused.items():
        warn(f"{files[number].name}: {why}")
    for text in sparse_parts(found, size):
        warn(text)
    print_wrote(output)


def calibrated(files: list[Path], views: list[SkyView], what: str) -> tuple[StarCamera, tuple[int, int]]:
    """The camera of night images, and their size."""
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
        return calibrate_by_stars(stars, views, size, progress=advance), size


def sparse_parts(found: StarCamera, size: tuple[int, int]) -> list[str]:
    """Which parts of the image saw too few stars, and what to do."""
    counts = [[0] * _PARTS for _ in range(_PARTS)]
    for pixels in found.pixels:
        for u, v in pixels.tolist():
            counts[min(int(v / size[1] * _PARTS), _PARTS - 1)][min(int(u / size[0] * _PARTS), _PARTS - 1)] += 1
    rows, columns = ("top", "middle", "bottom"), ("left", "center", "right")
    empty = [
        f"{row} {column}" for row, own in zip(rows, counts, strict=True) for column, n in zip(columns, own, strict=True)
        if n < _FEW_IN_A_PART
    ]  # fmt: skip
    if not empty:
        return []
    share = math.ceil(100 * len(empty) / _PARTS**2)
    return [
        f"{share} % of the image saw fewer than {_FEW_IN_A_PART} stars ({', '.join(empty)}): tilt the camera up and "
        "take more images, so that bright stars fall there"
    ]
