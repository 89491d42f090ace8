"""Stars for commands: `kcal stars`, and the `--stars` of `kcal budget`, `kcal calibrate` and `kcal rig`."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Annotated, Any

import kcal
from kcal.cli import kinds, rooms
from kcal.cli.console import followed, out, print_styled, print_table, print_wrote, steps, tell, warn
from kcal.cli.inputs import single_camera
from kcal.cli.options import Kind
from kcal.errors import InputError, KcalError
from kcal.files import check_writable

# Night images as commands read them: when and where they were taken, and the lens that their stars tell.


@dataclasses.dataclass(frozen=True, kw_only=True)
class Night:
    """When and where night images were taken.

    Args:
        site: Where the camera stands: latitude, longitude, height above the WGS84 ellipsoid.
        dut1: UT1 - UTC, if known; not known, it is 0 ± 0.52 s (8″).
        time_sigma: Standard deviation of the camera's clock; 1 s is 15″.
        temperature: Of the air, for refraction.
        pressure: At the camera; standard air if not given.
    """

    time: kinds.Times | None = None
    site: kinds.Site | None = None
    dut1: kinds.Clock | None = None
    time_sigma: kinds.Seconds = 0.1
    temperature: Annotated[kinds.Celsius, Kind(of="site")] | None = None
    pressure: Annotated[kinds.Hectopascal, Kind(of="site")] | None = None

    def view(self, path: Path) -> kcal.stars.SkyView:
        """Of one image."""
        known = {} if self.temperature is None else {"celsius": self.temperature, "celsius_sigma": 1.0}
        known |= {} if self.pressure is None else {"hectopascal": self.pressure, "hectopascal_sigma": 1.0}
        air = None if self.site is None else kcal.stars.Air.at_height(self.site.height, **known)
        time = rooms.time_of(self.time, path)
        return kcal.stars.SkyView(time=time, origin=self.site, air=air, dut1=self.dut1, time_sigma=self.time_sigma)


def camera_by_stars(
    files: list[Path], views: list[kcal.stars.SkyView], what: str, boards: rooms.CameraCalibrationResult | None = None
) -> tuple[rooms.StarCamera, tuple[int, int]]:
    """The camera of night images, and of what boards said of it before; and the images' size."""
    stars: list[rooms.DetectedStars] = []
    sizes = set()
    for path in followed("finding stars", files, lambda path: path.name):
        try:
            image = rooms.read_night(path)
            stars.append(kcal.stars.detect_stars(image))
        except KcalError as error:
            raise InputError(f"{path.name}: {error}") from error
        sizes.add((image.shape[1], image.shape[0]))
    if len(sizes) > 1:
        raise InputError(f"the images have several sizes ({sorted(sizes)}): one camera has one")
    (size,) = sizes
    with steps(what, None) as advance:
        return kcal.stars.calibrate_by_stars(stars, views, size, boards=boards, progress=advance), size


# What stars would give a planned rig, for `kcal budget --stars`.

# Meters: the range whose errors are told.
_DISTANCE = 5000.0
# Exposures in the table, seconds, and pairs of images.
_EXPOSURES, _PAIRS = (1 / 30, 0.25, 1.0, 4.0, 8.0), 20
_SKIES = {"rural": 20.5, "suburb": 18.0}


def print_star_budget(rig: kcal.Rig, aperture: float, altitude: float, clock: float) -> None:
    """Print how many stars a lens, an exposure and a sky give, and what range error follows from them.

    Args:
        rig: its left camera is the lens.
        aperture: of the lens, mm.
        altitude: of the middle of the image, degrees.
        clock: sigma of the offset between the cameras' clocks, seconds.
    """
    focal, size = float(rig.left.params[0]), rig.left.size
    out.print(
        f"stars: f {focal:g} px, {size[0]}x{size[1]}, aperture {aperture:g} mm, middle of the image {altitude:g}° up, "
        f"clocks ± {clock:g} s; range errors at {_DISTANCE:g} m from stars and clocks alone (lens and marks come on "
        "top)"
    )
    rows = [["sky", "exposure s", "stars", "faintest", "σ px", "trail px", "1 pair", f"{_PAIRS} pairs"]]
    told = []
    for sky, magnitude in _SKIES.items():
        for seconds in _EXPOSURES:
            plan = rooms.NightPlan(
                focal_px=focal, size=size, aperture_mm=aperture, seconds=seconds, sky_magnitude=magnitude,
                altitude_deg=altitude,
            )  # fmt: skip
            found = rooms.planned_stars(plan)
            shares = [found.range_share(_DISTANCE, float(rig.baseline), pairs, clock) for pairs in (1, _PAIRS)]
            some = math.isfinite(found.yaw_sigma)
            rows.append([
                sky, f"{seconds:.3g}", f"{found.stars:.0f}", f"{found.faintest:.1f}" if some else "",
                f"{found.sigma_px:.2f}" if some else "", f"{found.trail_px:.2f}",
                *(f"{100 * share:.2f} %" if some else "" for share in shares),
            ])  # fmt: skip
            told.append({
                "sky_magnitude": magnitude, "seconds": seconds, "stars": found.stars, "trail_px": found.trail_px,
                "range_share": shares if some else None,
            })  # fmt: skip
    tell(stars=told)
    print_table(rows)
    out.print("a photometric model, probably a magnitude too cautious; take an exposure with 20 stars or more")


# `kcal calibrate --stars`: a camera from night images, alone or together with boards.

# Parts of the image, across and down, whose stars are counted for the advice.
_PARTS = 3
_FEW_IN_A_PART = 3


def by_night(images: list[str] | None, night: Night, output: Path, name: str) -> None:
    """Calibrate a camera from the stars of night images alone, and write it.

    Args:
        images: files, folders and wildcards.
        night: when and where they were taken.
        output: camera file.
        name: of the camera.
    """
    if not images:
        raise InputError("give observations of a board (from `kcal detect`), or night images with --stars")
    camera = _by_stars(images, night, output).lens.camera
    if camera.calibration is not None and name:
        camera.calibration = dataclasses.replace(camera.calibration, name=name)
    kcal.save_camera(camera, output)
    out.print("at infinity, without an entrance pupil: for what is farther than some hundred pupil movements")
    print_wrote(output)


def joined_by_stars(
    boards: rooms.CameraCalibrationResult, images: list[str], night: Night, output: Path
) -> rooms.CameraCalibrationResult:
    """The calibration by boards, refined by stars. Other arguments as of `by_night`."""
    found = _by_stars(images, night, output, boards)
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
    images: list[str], night: Night, output: Path, boards: rooms.CameraCalibrationResult | None = None
) -> rooms.StarCamera:
    """Read the images, calibrate, and tell what was found."""
    if night.site is not None and night.time is None:
        raise InputError("--site without --time tells nothing: refraction depends on both")
    files = rooms.expand_nights(images)
    check_writable(output, *files)
    views = [night.view(path) for path in files]
    found, size = camera_by_stars(files, views, "calibrating by stars", boards)
    count = sum(int(use.sum()) for use in found.lens.used)
    left_out = sum(len(use) for use in found.lens.used) - count
    tell(
        images={files[number].name: len(star) for number, star in zip(found.images, found.stars, strict=True)},
        refused={files[number].name: why for number, why in found.refused.items()},
        stars=count, left_out=left_out, rms_px=found.lens.rms_px, effective=found.lens.effective,
        agreement=None if found.agreement is None else found.agreement._asdict(),
    )  # fmt: skip
    text = (
        f"{count} stars of {len(found.images)} images, {left_out} left out; RMS {found.lens.rms_px:.4f} px "
        f"along an axis; f {float(found.lens.camera.params[0]):.2f} px; the stars determine {found.lens.effective:.1f} "
        "unknowns of the lens"
    )
    print_styled(text, r"(?<=; RMS )\S+ px")
    warn(*(f"{files[number].name}: {why}" for number, why in found.refused.items()))
    warn(*sparse_parts(found, size))
    if night.site is None:
        warn(
            "without --time and --site refraction stays in the lens: it shrinks heights by 0.03 % overhead, 0.12 % at "
            "30° of altitude and 1 % at 10°; give both"
        )
    return found


def sparse_parts(found: rooms.StarCamera, size: tuple[int, int]) -> list[str]:
    """Which parts of the image saw too few stars, and what to do."""
    import numpy as np

    column, row = (np.concatenate(found.pixels) / size * _PARTS).astype(int).clip(max=_PARTS - 1).T
    counts = np.bincount(row * _PARTS + column, minlength=_PARTS**2).tolist()
    parts = [f"{row} {column}" for row in ("top", "middle", "bottom") for column in ("left", "center", "right")]
    empty = [part for part, count in zip(parts, counts, strict=True) if count < _FEW_IN_A_PART]
    if not empty:
        return []
    share = math.ceil(100 * len(empty) / _PARTS**2)
    return [
        f"{share} % of the image saw fewer than {_FEW_IN_A_PART} stars ({', '.join(empty)}): tilt the camera up and "
        "take more images, so that bright stars fall there"
    ]


# `kcal stars`: name the stars of night images, and find how the camera looks.

_EARTH, _SKY = ("heading_deg", "pitch_deg", "roll_deg"), ("right_ascension_deg", "declination_deg")


def stars_command(
    images: list[kinds.Images],
    *,
    camera: Annotated[str, Kind(metavar="CAMERA")] | None = None,
    night: Night,
    picture: kinds.Picture | None = None,
) -> None:
    """Name the stars of night images, and find how the camera looks.

    The stars are named by their pattern: nothing need be known of where the camera looks. With time and place the
    attitude is that on the Earth (WGS84), refraction included; otherwise it is that among the stars. Hot pixels,
    satellites, aircraft, clouds and lamps are left out and counted. It needs the extra `stars`: `pip install
    'kcal[stars]'`.

    **Examples**

    `kcal stars night/ --camera left.camera.json --time name:Z --site 40.762,-113.896,1282`

    `kcal stars night/0001.png --camera left.camera.json --picture named.png`

    Args:
        images: Night images of one camera: files, folders or quoted wildcards; PNG (8 or 16 bit), FITS, or a video
            whose frames are summed.
        camera: Camera file; FILE:left names one of a rig. Without one, the lens is found from the stars first.
        picture: the first image that has names, with them.
    """
    files = rooms.expand_nights(images)
    if picture is not None:
        check_writable(picture, *files)
    views = [night.view(path) for path in files]
    catalog = kcal.stars.StarCatalog.bundled()
    lens = single_camera(camera) if camera else camera_by_stars(files, views, "finding the lens")[0].lens.camera
    told: list[dict[str, Any]] = []
    seen: list[tuple[dict[str, Any], rooms.NamedStars]] = []
    angles = ["heading", "pitch", "roll", "± east", "± north", "± up"]
    if not views[0].on_earth:
        angles = ["right ascension", "declination", "± x", "± y", "± z"]
    for path, view in zip(followed("naming stars", files, lambda path: path.name), views, strict=True):
        try:
            image = rooms.read_night(path)
            found = kcal.stars.name_stars(image, lens, view, catalog)
        except KcalError as error:
            if len(files) == 1:
                raise
            told.append({"image": path.name, "identified": 0, "error": str(error)})
            warn(f"{path.name}: {error}")
        else:
            if picture is not None and not seen:
                _draw(picture, image, found, catalog, path.name)
            told.append(_told(path, found))
            seen.append((told[-1], found))
            warn(*(f"{path.name}: {text}" for text in found.warnings))
    for number, text in rooms.clock_doubts([found for _, found in seen]):
        warn(f"{seen[number][0]['image']}: {text}")
        seen[number][0]["warnings"].append(text)
    tell(images=told)
    if not seen:
        raise InputError(f"in none of {len(files)} images stars have names")
    print_table([["image", "stars", "named", "RMS px", *angles, "left out"], *(_row(*one) for one in seen)])
    if views[0].on_earth and night.dut1 is None:
        out.print("UT1 - UTC is not known (--dut1): it is part of the σ about the Earth's axis with 8″")
    turned = max(rooms.turn_by_lens(lens, found.detected.pixels[found.attitude.star >= 0]) for _, found in seen)
    tell(lens_turn_deg=turned)
    if turned > max(max(found.sigma_deg) for _, found in seen):
        out.print(
            f"± is of the stars, under this lens: its principal point, not known better, may turn all attitudes by "
            f"± {turned:.2g}° more; where pixels look does not change"
        )
    print_wrote(picture)


def _row(told: dict[str, Any], found: rooms.NamedStars) -> list[str]:
    angles = [value for name, value in told.items() if name in (*_EARTH, *_SKY)]
    cells = [f"{degrees:.4f}°" for degrees in (*angles, *told["sigma_deg"])]
    if found.view.on_earth and not found.on_earth:
        cells = 6 * [""]
    left_out = ", ".join(f"{count} {reason}" for reason, count in told["left_out"].items())
    return [told["image"], f"{told['detected']}", f"{told['identified']}", f"{told['rms_px']:.3f}", *cells, left_out]


def _told(path: Path, found: rooms.NamedStars) -> dict[str, Any]:
    angles = found.heading_pitch_roll or found.right_ascension_declination or ()
    return {
        "image": path.name,
        "time": None if found.view.time is None else found.view.time.isoformat(),
        "detected": len(found.detected.pixels),
        "identified": found.attitude.count,
        "rms_px": found.attitude.rms_px,
        "frame": "east-north-up" if found.on_earth else "celestial",
        **dict(zip(_EARTH if found.on_earth else _SKY, angles, strict=True)),
        "sigma_deg": list(found.sigma_deg),
        "rotation": found.attitude.rotation.tolist(),
        "left_out": dict(found.detected.left_out),
        "warnings": list(found.warnings),
    }


def _draw(picture: Path, image: Any, found: rooms.NamedStars, catalog: kcal.stars.StarCatalog, title: str) -> None:
    names = [catalog.name_of(int(catalog.number[i])) if i >= 0 else "" for i in found.attitude.star.tolist()]
    figure = rooms.stars_figure(image, found.detected.pixels, names, found.attitude.residual, title)
    kcal.report.save_picture(picture, figure)
