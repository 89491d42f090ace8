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
from kcal.errors import InputError
from kcal.files import check_writable

if TYPE_CHECKING:
    from kcal.calibrate.rig.result import RigResult
    from kcal.calibrate.rig.solve import RigOptions
    from kcal.calibrate.rig.sources import MeasuredPosition, RigData
    from kcal.cli.rig_sources import Sources
    from kcal.lens.camera_rig import CameraRig
    from kcal.lens.mounting import Origin


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
    paths: Sequence[Path], sources: Sources, options: RigOptions, output: Path, observations: Sequence[Path] = ()
) -> None:
    """Solve one camera, or three and more, write the rig and print how each stands."""
    from kcal.calibrate.rig.solve import solve_rig
    from kcal.io.camera_file import load_camera
    from kcal.io.camera_rig_file import save_camera_rig

    names = camera_names(paths)
    for given, option in ((sources.pairs, "--pairs"), (sources.stars, "--stars"), (sources.baseline, "--baseline")):
        if given is not None:
            instead = "; give boards by --observations" if option == "--pairs" else ""
            raise InputError(f"{option} is for rigs of two cameras{instead}")
    check_writable(output, *paths, *sources.files, *observations)
    data, origin = _read_stations(tuple(map(load_camera, paths)), names, sources, observations)
    with steps("solving the stations", 1) as advance:
        result = solve_rig(data, options)
        advance("done")
    rig = result.stations(origin)
    assert rig.calibration is not None
    rig.calibration = dataclasses.replace(rig.calibration, pixel_sigma=sources.mark_sigma)
    save_camera_rig(rig, output)
    tell(
        rms_px=result.rms, cameras=_stands(rig), warnings=list(result.warnings), undetermined=list(result.undetermined)
    )
    _print_stations(result, rig)
    print_wrote(output)


def _read_stations(
    cameras: tuple, names: tuple[str, ...], sources: Sources, observations: Sequence[Path]
) -> tuple[RigData, Origin | None]:
    from kcal.calibrate.rig.pairs import boards_of_several
    from kcal.calibrate.rig.sources import RigData
    from kcal.corners.observations import Observations
    from kcal.lens.mounting import Origin
    from kcal.locate.survey import camera_positions
    from kcal.locate.survey_files import import_survey
    from kcal.locate.view_marks import match_views, read_feature_views, read_views

    if (sources.landmarks is None) != (sources.marks is None):
        raise InputError("--landmarks and --marks belong together: places by name, and where they are in the images")
    origin = None if sources.origin is None else Origin.parse(sources.origin)
    positions: tuple[MeasuredPosition, ...] = ()
    if sources.positions is not None:
        placed = import_survey(sources.positions, origin, sigma=sources.survey_sigma, geoid=sources.geoid)
        origin, positions = placed.origin, camera_positions(placed, names)
    landmarks = None
    if sources.landmarks is not None and sources.marks is not None:
        survey = import_survey(sources.landmarks, origin, sigma=sources.survey_sigma, geoid=sources.geoid)
        if sources.positions is not None and survey.origin != origin:
            raise InputError("landmarks and positions: one has latitudes, the other local meters; give an --origin")
        origin = survey.origin
        found = match_views(survey, read_views(sources.marks, names, others=len(names) == 1), sources.mark_sigma)
        landmarks = found.landmarks
        for some, text in ((found.unmarked, "surveyed, but not marked"), (found.unsurveyed, "marked, not surveyed")):
            if some:
                err.print(f"[yellow]warning:[/] {text}:", ", ".join(some), markup=True)
    views = {}
    for path in observations:
        name = path.name.split(".")[0]
        if name not in names:
            raise InputError(f"{path}: no camera is named {name!r}; they are {', '.join(names)}")
        views[names.index(name)] = Observations.load(path)
    data = RigData(
        cameras=cameras,
        names=names,
        boards=boards_of_several(cameras, names, views) if views else None,
        landmarks=landmarks,
        features=None if sources.features is None else read_feature_views(sources.features, names, sources.mark_sigma),
        positions=positions,
    )
    return data, origin


def _print_stations(result: RigResult, rig: CameraRig) -> None:
    from kcal.cli.rig_text import print_rig, source_lines

    print_rig(result, source_lines(result))
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
    landmarks: Annotated[Path, typer.Argument(help="Surveyed places, as for `kcal rig --landmarks`."), SURVEY],
    marks: Annotated[
        Path,
        typer.Option(metavar="CSV", help="Where they are in the image: name,camera,u,v, camera by file name."),
        MARKS,
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Rig file to write, with one camera.")],
    position: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="Its measured position (GNSS), as a table of places with its name."),
        SURVEY,
    ] = None,
    origin: Annotated[
        str | None, typer.Option(metavar="LAT,LON,HEIGHT", help="Of the local frame, if the places have none.")
    ] = None,
    pixel_sigma: PixelSigma = None,
) -> None:
    """Solve how one camera stands on the Earth: position, heading, pitch and roll, with error bars.

    Four landmarks are needed, six or more are good. Their light is bent as it is for `kcal rig`, and east, north and
    up are those at the camera. `kcal locate` then gives bearings, or positions of what stands at a known height.

    **Example**

    `kcal station mast.camera.json survey.csv --marks marks.csv -o mast.rig.json`
    """
    from kcal.calibrate.rig.solve import RigOptions
    from kcal.cli.rig_sources import Sources

    sources = Sources(
        landmarks=landmarks, marks=marks, positions=position, origin=origin, mark_sigma=pixel_sigma or ASSUMED
    )
    solve_stations([camera], sources, RigOptions(), output)


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
