"""Rigs of three and more cameras, and one alone, for `kcal rig`, `kcal station` and `kcal locate`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kcal.cli.console import err, out, print_table, print_wrote, steps, tell
from kcal.cli.inputs import CALIBRATED, MARKS, SURVEY
from kcal.cli.pixel_sigma import ASSUMED, PixelSigma
from kcal.cli.rig_skyline import IMAGES_HELP, PICTURE_HELP, SIGMA_HELP, SKYLINE_HELP, skyline_options
from kcal.errors import InputError
from kcal.files import check_writable

if TYPE_CHECKING:
    from kcal.calibrate.rig.result import RigResult
    from kcal.calibrate.rig.solve import RigOptions
    from kcal.cli.rig_sources import Sources
    from kcal.lens.camera_rig import CameraRig
    from kcal.report.verdict import Requirement


def camera_names(paths: Sequence[Path]) -> tuple[str, ...]:
    """Names of camera files up to their first dots.

    Raises:
        InputError: two of one name.
    """
    names = tuple(path.name.split(".")[0] for path in paths)
    for path, name in zip(paths, names, strict=True):
        if names.count(name) > 1:
            raise InputError(f"{path}: two cameras are named {name!r}; rename a file: marks are told apart by them")
    return names


def solve_stations(
    paths: Sequence[Path], sources: Sources, options: RigOptions, output: Path, *, needs: tuple[Requirement, ...] = (),
    report: Path | None = None, picture: Path | None = None,
) -> None:  # fmt: skip
    """Solve one camera, or three and more, write the rig, print how each stands and whether it may be used."""
    from kcal.calibrate.rig.solve import solve_rig
    from kcal.cli.rig_sources import read_sources
    from kcal.io.camera_file import load_camera
    from kcal.io.camera_rig_file import save_camera_rig

    names = camera_names(paths)
    for given, option, instead in (
        (sources.pairs, "--pairs", "give boards by --observations"),
        (sources.match, "--match", "views belong together by their names"),
        (sources.scene, "--scene", "give matches as a table by --features"),
    ):
        if given is not None:
            raise InputError(f"{option} is for rigs of two cameras; {instead}")
    check_writable(output, *paths, *sources.files)
    sources = dataclasses.replace(sources, names=names)
    data, origin, _, notes, _, told = read_sources(tuple(map(load_camera, paths)), sources)
    with steps("solving the stations", None) as advance:
        result = solve_rig(data, options, advance)
    rig = result.stations(origin)
    assert rig.calibration is not None
    rig.calibration = dataclasses.replace(rig.calibration, pixel_sigma=sources.mark_sigma)
    tell(
        rms_px=result.rms, cameras=_stands(rig), warnings=list(result.warnings), undetermined=list(result.undetermined),
        left_out={item.label: item.reason for item in result.left_out},
    )  # fmt: skip
    save_camera_rig(rig, output)
    if picture is not None:
        from kcal.report.rig import save_rig_picture

        save_rig_picture(picture, result)
    _print_stations(result, rig, [*notes, *told(result)])
    print_wrote(output, picture)
    if needs or report is not None:
        from kcal.cli.report import NO, stored_tables, told_usable
        from kcal.report.judge_rig import rig_verdict
        from kcal.report.rig import rig_figure
        from kcal.report.verdict_pictures import png_bytes

        subject = output.name.split(".")[0]
        verdict = rig_verdict(rig, needs, mark_sigma=sources.mark_sigma, result=result, subject=subject)
        tell(verdict=verdict.to_dict())
        if not told_usable(verdict, lambda: {"rig": png_bytes(rig_figure(result))}, stored_tables(rig), report):
            raise typer.Exit(NO)


def _print_stations(result: RigResult, rig: CameraRig, notes: Sequence[str]) -> None:
    from kcal.cli.rig_text import print_rig, source_lines

    print_rig(result, [*source_lines(result), *notes])
    print_table(station_rows(rig))
    if rig.root is None:
        err.print("[yellow]warning:[/] the data leave something open, so that the rig has no error bars")
    if rig.origin is None:
        out.print("No latitudes were given: positions are meters of the local frame. --origin anchors it on the Earth.")


def station_rows(rig: CameraRig) -> list[list[str]]:
    """A table of how each camera stands, heads first: on the Earth with error bars, or in the rig's own frame."""
    from kcal.locate.stations import station_mounting
    from kcal.quantities import length_text, measured_text, number_text

    rows = [["camera", "RMS px", "lat", "lon", "height m", "± level", "± up", "heading °", "pitch °", "roll °"]]
    if rig.origin is None:
        rows = [["camera", "RMS px", "east m", "north m", "up m"]]
    residuals = rig.calibration.rms_px if rig.calibration else (None,) * len(rig)
    for c, (name, residual) in enumerate(zip(rig.names, residuals, strict=True)):
        rms = "" if residual is None else f"{residual:.3f}"
        if rig.origin is None:
            rows.append([name, rms, *(f"{value:.3f}" for value in rig.center[c].tolist())])
            continue
        stands = station_mounting(rig, c)
        place = [f"{stands.origin.lat:.7f}", f"{stands.origin.lon:.7f}"]
        angles = (stands.heading_deg, stands.pitch_deg, stands.roll_deg)
        if rig.root is None or stands.covariance is None:
            rows.append([name, rms, *place, f"{stands.origin.height:.2f}", "", "", *(f"{a:.4f}" for a in angles)])
            continue
        sigma = stands.covariance.diagonal().sqrt().tolist()
        level = math.degrees(max(sigma[3:5]))
        rows.append(
            [name, rms, *place, number_text(stands.origin.height, sigma[2]), length_text(max(sigma[:2]), digits=2),
             length_text(sigma[2], digits=2), measured_text(angles[0], math.degrees(sigma[5])),
             measured_text(angles[1], level), number_text(angles[2], level)]
        )  # fmt: skip
    return rows


def _stands(rig: CameraRig) -> dict[str, dict[str, float]]:
    """How each camera stands, for --json."""
    from kcal.locate.stations import station_mounting

    if rig.origin is None:
        return {}
    told = {}
    for c, name in enumerate(rig.names):
        stands = station_mounting(rig, c)
        told[name] = dataclasses.asdict(stands.origin) | {
            "heading_deg": stands.heading_deg, "pitch_deg": stands.pitch_deg, "roll_deg": stands.roll_deg,
        }  # fmt: skip
        if rig.root is not None and stands.covariance is not None:
            sigma = stands.covariance.diagonal().sqrt().tolist()
            told[name] |= {"sigma_m": max(sigma[:3]), "sigma_deg": math.degrees(max(sigma[3:6]))}
    return told


def station_command(
    camera: Annotated[Path, typer.Argument(help="Camera file."), CALIBRATED],
    output: Annotated[Path, typer.Option("-o", "--output", help="Rig file to write, with one camera.")],
    landmarks: Annotated[
        Path | None, typer.Argument(help="Surveyed places, as for `kcal rig --landmarks`."), SURVEY
    ] = None,
    marks: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="Where they are in the image: name,camera,u,v, camera by file name."),
        MARKS,
    ] = None,
    position: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="Its measured position (GNSS), as a table of places with its name."),
        SURVEY,
    ] = None,
    origin: Annotated[
        str | None, typer.Option(metavar="LAT,LON,HEIGHT", help="Of the local frame, if the places have none.")
    ] = None,
    skyline: Annotated[Path | None, typer.Option(metavar="DEM", help=SKYLINE_HELP)] = None,
    skyline_images: Annotated[
        list[str] | None, typer.Option("--skyline-images", metavar="IMAGES", help=IMAGES_HELP)
    ] = None,
    skyline_sigma: Annotated[float | None, typer.Option("--skyline-sigma", metavar="M", help=SIGMA_HELP, min=0)] = None,
    skyline_picture: Annotated[Path | None, typer.Option("--skyline-picture", help=PICTURE_HELP)] = None,
    geoid: Annotated[
        float | None, typer.Option(metavar="M", help="Height of the geoid above the WGS84 ellipsoid, for --skyline.")
    ] = None,
    pixel_sigma: PixelSigma = None,
) -> None:
    """Solve how one camera stands on the Earth: position, heading, pitch and roll, with error bars.

    Four landmarks are needed, six or more are good; or images of the skyline, a raster of the terrain (--skyline) and
    the measured position. Light of landmarks is bent as for `kcal rig`; east, north and up are those at the camera.
    `kcal locate` then gives bearings, or positions of what stands at a known height.

    **Example**

    `kcal station mast.camera.json survey.csv --marks marks.csv -o mast.rig.json`

    `kcal station mast.camera.json --position gnss.csv --skyline dem.tif --skyline-images noon.jpg -o mast.rig.json`
    """
    from kcal.calibrate.rig.solve import RigOptions
    from kcal.cli.rig_sources import Sources

    if landmarks is None and skyline is None:
        raise typer.BadParameter("give surveyed places and --marks, or a raster of the terrain (--skyline)")
    options = RigOptions()
    sources = Sources(
        landmarks=landmarks, marks=marks, positions=position, origin=origin, mark_sigma=pixel_sigma or ASSUMED,
        geoid=geoid,
        skyline=skyline_options(
            skyline, skyline_images or (), None, geoid, skyline_sigma, (options.refraction, options.refraction_sigma),
            skyline_picture,
        ),
    )  # fmt: skip
    solve_stations([camera], sources, options, output)


def parse_height(text: str) -> tuple[float, float]:
    """`"12"` or `"12±3"`, meters above the ellipsoid; ± 1 m if not given.

    Raises:
        InputError: not that.
    """
    parts = text.replace("+-", "±").split("±")
    try:
        values = [float(part) for part in parts]
    except ValueError:
        values = []
    if len(values) not in (1, 2) or not all(map(math.isfinite, values)) or (len(values) == 2 and not values[1] > 0):
        raise InputError(f"height {text!r}: write meters above the ellipsoid, and their sigma, for example 12±3")
    return values[0], values[1] if len(values) == 2 else 1.0
