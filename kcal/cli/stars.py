"""`kcal stars`: name the stars of night images, and find how the camera looks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kcal.cli.console import out, print_table, print_wrote, steps, tell, warn
from kcal.cli.inputs import IMAGES
from kcal.cli.night_images import TIME_HELP, sky_view
from kcal.errors import InputError, KcalError
from kcal.files import check_writable

if TYPE_CHECKING:
    from kcal.stars.catalog import StarCatalog
    from kcal.stars.night import NamedStars, SkyView


def stars_command(
    images: Annotated[
        list[str],
        typer.Argument(
            metavar="IMAGES",
            help="Night images of one camera: files, folders or quoted wildcards; PNG (8 or 16 bit), FITS, or a video "
            "whose frames are summed.",
            show_default=False,
        ),
        IMAGES,
    ],
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="CAMERA",
            help="Camera file; FILE:left names one of a rig. Without one, the lens is found from the stars first.",
        ),
    ] = None,
    time: Annotated[str | None, typer.Option(metavar="TIME", help=TIME_HELP)] = None,
    lat: Annotated[float | None, typer.Option(metavar="DEG", help="Latitude of the camera.")] = None,
    lon: Annotated[float | None, typer.Option(metavar="DEG", help="Longitude of the camera.")] = None,
    height: Annotated[float, typer.Option(metavar="M", help="Height above the WGS84 ellipsoid.")] = 0.0,
    dut1: Annotated[
        float | None, typer.Option(metavar="S", help="UT1 - UTC, if known; not known, it is 0 ± 0.52 s (8″).")
    ] = None,
    time_sigma: Annotated[float, typer.Option(metavar="S", help="Of the camera's clock; 1 s is 15″.", min=0)] = 0.1,
    celsius: Annotated[float | None, typer.Option(metavar="C", help="Temperature, for refraction.")] = None,
    hectopascal: Annotated[
        float | None, typer.Option(metavar="HPA", help="Pressure at the camera; standard air if not given.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="A .png or .svg file: the first image that has names, with them.")
    ] = None,
) -> None:
    """Name the stars of night images, and find how the camera looks.

    The stars are named by their pattern: nothing need be known of where the camera looks. With time and place the
    attitude is that on the Earth (WGS84), refraction included; otherwise it is that among the stars. Hot pixels,
    satellites, aircraft, clouds and lamps are left out and counted. It needs the extra `stars`: `pip install
    'kcal[stars]'`.

    **Examples**

    `kcal stars night/ --camera left.camera.json --time name:Z --lat 40.762 --lon -113.896 --height 1282`

    `kcal stars night/0001.png --camera left.camera.json --picture named.png`
    """
    from kcal.cli.camera_sources import single_camera
    from kcal.stars.catalog import StarCatalog
    from kcal.stars.contradictions import clock_doubts
    from kcal.stars.night import name_stars
    from kcal.stars.night_image import expand_nights, read_night

    if picture is not None:
        from kcal.report.figures import check_picture

        check_picture(picture)
    files = expand_nights(images)
    if picture is not None:
        check_writable(picture, *files)
    views = [
        sky_view(path, time, lat, lon, height, dut1=dut1, time_sigma=time_sigma, celsius=celsius, pressure=hectopascal)
        for path in files
    ]
    catalog = StarCatalog.bundled()
    if camera is None:
        from kcal.cli.night_images import camera_by_stars

        lens = camera_by_stars(files, views, "finding the lens")[0].lens.camera
    else:
        lens = single_camera(camera)
    told: list[dict[str, Any]] = []
    named: list[tuple[str, NamedStars]] = []
    rows = [["image", "stars", "named", "RMS px", *_heads(views[0])]]
    drawn = picture is None
    with steps("naming stars", len(files)) as advance:
        for path, view in zip(files, views, strict=True):
            try:
                image = read_night(path)
                found = name_stars(image, lens, view, catalog)
            except KcalError as error:
                if len(files) == 1:
                    raise
                told.append({"image": path.name, "identified": 0, "error": str(error)})
                warn(f"{path.name}: {error}")
            else:
                told.append(_told(path, found))
                named.append((path.name, found))
                rows.append(_row(path, found))
                for text in found.warnings:
                    warn(f"{path.name}: {text}")
                if not drawn:
                    assert picture is not None
                    _draw(picture, image, found, catalog, path.name)
                    drawn = True
            advance(path.name)
    for number, text in clock_doubts([found for _, found in named]):
        warn(f"{named[number][0]}: {text}")
        next(image for image in told if image["image"] == named[number][0])["warnings"].append(text)
    tell(images=told)
    if len(rows) == 1:
        raise InputError(f"in none of {len(files)} images stars have names")
    print_table(rows)
    _say_unknown(views[0])
    print_wrote(picture)


def _heads(view: SkyView) -> list[str]:
    if view.on_earth:
        return ["heading", "pitch", "roll", "± east", "± north", "± up", "left out"]
    return ["right ascension", "declination", "± x", "± y", "± z", "left out"]


def _row(path: Path, found: NamedStars) -> list[str]:
    angles = found.heading_pitch_roll or found.right_ascension_declination or ()
    cells = [f"{angle:.4f}°" for angle in angles] + [f"{sigma:.4f}°" for sigma in found.sigma_deg]
    if found.view.on_earth and not found.on_earth:
        cells = ["", "", "", "", "", ""]
    left_out = ", ".join(f"{count} {reason}" for reason, count in found.detected.left_out.items())
    stars = found.attitude
    return [path.name, f"{len(found.detected.pixels)}", f"{stars.count}", f"{stars.rms_px:.3f}", *cells, left_out]


def _told(path: Path, found: NamedStars) -> dict[str, Any]:
    angles: dict[str, Any]
    if (on_earth := found.heading_pitch_roll) is not None:
        angles = dict(zip(("heading_deg", "pitch_deg", "roll_deg"), on_earth, strict=True))
    else:
        assert found.right_ascension_declination is not None
        angles = dict(zip(("right_ascension_deg", "declination_deg"), found.right_ascension_declination, strict=True))
    return {
        "image": path.name,
        "time": None if found.view.time is None else found.view.time.isoformat(),
        "detected": len(found.detected.pixels),
        "identified": found.attitude.count,
        "rms_px": found.attitude.rms_px,
        "frame": "east-north-up" if found.on_earth else "celestial",
        **angles,
        "sigma_deg": list(found.sigma_deg),
        "rotation": found.attitude.rotation.tolist(),
        "left_out": dict(found.detected.left_out),
        "warnings": list(found.warnings),
    }


def _draw(picture: Path, image: Any, found: NamedStars, catalog: StarCatalog, title: str) -> None:
    from kcal.report.stars import save_stars_picture

    star = found.attitude.star.tolist()
    names = [catalog.name_of(int(catalog.number[i])) if i >= 0 else "" for i in star]
    save_stars_picture(picture, image, found.detected.pixels, names, found.attitude.residual, title)


def _say_unknown(view: SkyView) -> None:
    if view.on_earth and view.dut1 is None:
        out.print("UT1 - UTC is not known (--dut1): it is part of the σ about the Earth's axis with 8″")
