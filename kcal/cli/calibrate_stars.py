"""`kcal calibrate --stars`: a camera from night images, alone or together with boards."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kcal.cli.console import out, print_wrote, tell, warn
from kcal.errors import InputError
from kcal.files import check_writable

if TYPE_CHECKING:
    from kcal.calibrate.camera.result import CameraCalibrationResult
    from kcal.stars.lens import StarCamera

# Parts of the image, across and down, whose stars are counted for the advice.
_PARTS = 3
_FEW_IN_A_PART = 3


def by_night(images: list[str] | None, time: str | None, place: str | None, output: Path, name: str) -> None:
    """Calibrate a camera from the stars of night images alone, and write it.

    Args:
        images: files, folders and wildcards.
        time: as `--time`.
        place: as `--place`: latitude, longitude and height, for refraction.
        output: camera file.
        name: of the camera.
    """
    from kcal.io.camera_file import save_camera

    if not images:
        raise InputError("give observations of a board (from `kcal detect`), or night images with --stars")
    found = _by_stars(images, time, place, output)
    camera = found.lens.camera
    if camera.calibration is not None and name:
        import dataclasses

        camera.calibration = dataclasses.replace(camera.calibration, name=name)
    save_camera(camera, output)
    out.print("at infinity, without an entrance pupil: for what is farther than some hundred pupil movements")
    print_wrote(output)


def joined_by_stars(
    boards: CameraCalibrationResult, images: list[str], time: str | None, place: str | None, output: Path
) -> CameraCalibrationResult:
    """The calibration by boards, refined by stars; arguments as of `by_night`."""
    found = _by_stars(images, time, place, output, boards)
    agreement, joint = found.agreement, found.joint
    assert agreement is not None
    assert joint is not None
    share = agreement.chi2 / max(agreement.freedom, 1)
    out.print(
        f"boards and stars: χ² over its {agreement.freedom} directions {share:.2f}; stars move the lens by "
        f"{agreement.moved_px:.3f} px, where boards stated ± {agreement.stated_px:.3f} px. From both:"
    )
    return joint


def _by_stars(
    images: list[str], time: str | None, place: str | None, output: Path, boards: CameraCalibrationResult | None = None
) -> StarCamera:
    """Read the images, calibrate, and tell what was found."""
    from kcal.cli.night_images import camera_by_stars, sky_view
    from kcal.lens.mounting import Origin
    from kcal.stars.night_image import expand_nights

    origin = None if place is None else Origin.parse(place)
    if origin is not None and time is None:
        raise InputError("--place without --time tells nothing: refraction depends on both")
    where: tuple[Any, Any, float] = (None, None, 0.0)
    if origin is not None:
        where = (origin.lat, origin.lon, origin.height)
    files = expand_nights(images)
    check_writable(output, *files)
    views = [sky_view(path, time, *where) for path in files]
    found, size = camera_by_stars(files, views, "calibrating by stars", boards)
    count = sum(int(use.sum()) for use in found.lens.used)
    left_out = sum(len(use) for use in found.lens.used) - count
    tell(
        images={files[number].name: len(star) for number, star in zip(found.images, found.stars, strict=True)},
        refused={files[number].name: why for number, why in found.refused.items()},
        stars=count, left_out=left_out, rms_px=found.lens.rms_px, effective=found.lens.effective,
        agreement=None if found.agreement is None else found.agreement._asdict(),
    )  # fmt: skip
    out.print(
        f"{count} stars of {len(found.images)} images, {left_out} left out; RMS [bold]{found.lens.rms_px:.4f} px[/] "
        f"along an axis; f {float(found.lens.camera.params[0]):.2f} px; the stars determine {found.lens.effective:.1f} "
        "unknowns of the lens"
    )
    for number, why in found.refused.items():
        warn(f"{files[number].name}: {why}")
    for text in sparse_parts(found, size):
        warn(text)
    if origin is None:
        warn(
            "without --time and --place refraction stays in the lens: it shrinks heights by 0.03 % overhead, 0.12 % at "
            "30° of altitude and 1 % at 10°; give both"
        )
    return found


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
