"""What `kcal locate` does with a table, part by part: pairs of a rig of two cameras, or marks of any number of them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import typer

from kcal.cli.console import err, warn
from kcal.cli.inputs import typed_with
from kcal.cli.pixel_sigma import pixel_sigma_and_source
from kcal.cli.settings import taken
from kcal.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from kcal.lens.mounting import Origin
    from kcal.lens.rig import StereoRig
    from kcal.locate.columns import PositionColumns
    from kcal.locate.positions import Located
    from kcal.locate.station_positions import ViewsLocator
    from kcal.locate.tabulate import Locator


@dataclasses.dataclass(frozen=True, kw_only=True)
class LocateOptions:
    """What the user gave besides the files, as on the command line."""

    pixel_sigma: float | None = None
    place: Origin | None = None
    heading: float | None = None
    pitch: float = 0.0
    roll: float = 0.0
    grid: str | None = None
    yaw_sigma: float = 0.0
    aged: str | None = None
    watch: Path | None = None
    heading_sigma: float = 0.0
    origin_sigma: float = 0.0
    refraction: float | None = None
    refraction_sigma: float | None = None
    height: tuple[float, float] | None = None
    terrain: Path | None = None
    terrain_sigma: float = 3.0
    geoid_height: float = 0.0
    geoid: Path | None = None


class LocatedPart(NamedTuple):
    """Some rows of a table.

    Attributes:
        columns: their positions.
        feet: (N, 3) where bearings count from, of several cameras; None: the left camera.
        stated: whether the table says how noisy its marks are.
        bytes_read: how far it has been read.
    """

    columns: PositionColumns
    feet: Tensor | None
    stated: bool
    bytes_read: int


class LocateRun(NamedTuple):
    """A table that is about to be located.

    Attributes:
        locate: by which it is.
        empty: what is known of all positions, without any.
        parts: locates it, part by part.
        doubts: what the rig's file warns of.
        note: where the noise of marks is from, to be said if the table does not state it.
    """

    locate: Locator | ViewsLocator
    empty: Located
    parts: Iterator[LocatedPart]
    doubts: Sequence[str]
    note: str


def locate_run(rig: Path, points: Path, options: LocateOptions) -> LocateRun:
    """Read a rig and begin a table: marks of several cameras, or of one with a height or a terrain, or pairs."""
    from kcal.locate.stations import names_of_rig
    from kcal.locate.view_marks import is_long

    alone = options.height is not None or options.terrain is not None
    if alone or is_long(points) or len(names_of_rig(rig)) != 2:
        return _of_stations(rig, points, options)
    return _of_pairs(rig, points, options)


def _of_stations(rig: Path, points: Path, options: LocateOptions) -> LocateRun:
    from kcal.locate.datum import find_geoid
    from kcal.locate.raster import terrain
    from kcal.locate.station_positions import ViewsLocator
    from kcal.locate.stations import load_camera_rig
    from kcal.locate.view_marks import read_view_chunks

    own = options
    elsewhere = any(
        (
            own.place, own.yaw_sigma, own.heading_sigma, own.origin_sigma, own.refraction, own.refraction_sigma,
            own.aged, own.watch,
        )
    )  # fmt: skip
    if elsewhere and not {"origin", "heading"} & taken:
        raise typer.BadParameter(
            "of several cameras position, attitude and their errors come from the rig file: leave out --origin, "
            "--heading, --yaw-sigma, --heading-sigma, --origin-sigma, --refraction, --aged and --watch"
        )
    if own.height is not None and own.terrain is not None:
        raise typer.BadParameter("--height and --terrain both say where a thing that one camera saw stands: give one")
    stations = load_camera_rig(rig)
    noise, note = pixel_sigma_and_source(own.pixel_sigma, stations)
    ground = None if own.terrain is None else terrain(own.terrain, own.geoid_height)
    height = own.height if ground is None else (0.0, own.terrain_sigma)
    locate = ViewsLocator(stations, pixel_sigma=noise, height=height, ground=ground, geoid=find_geoid(own.geoid))

    def parts() -> Iterator[LocatedPart]:
        for views, read in read_view_chunks(points, stations.names):
            yield LocatedPart(*locate(views), bool(views.sigma.isfinite().any()), read)

    doubts = _warned(rig, stations.calibration.warnings if stations.calibration else ())
    return LocateRun(locate, locate.located(), parts(), doubts, note)


def _of_pairs(rig: Path, points: Path, options: LocateOptions) -> LocateRun:
    from kcal.cli.watched_rows import located_at
    from kcal.io.rig_file import load_rig
    from kcal.lens.rig import RigCovariance
    from kcal.locate.aging import parse_aging
    from kcal.locate.datum import find_geoid, true_from_grid
    from kcal.locate.marks import filled, read_mark_chunks
    from kcal.locate.mounting import run_errors
    from kcal.locate.positions import located_by
    from kcal.locate.tabulate import Locator

    own = options
    if own.aged and own.watch:
        raise typer.BadParameter("--aged guesses what the history of --watch tells: give either")
    yaw_sigma = math.hypot(own.yaw_sigma, parse_aging(own.aged))
    solved, place, heading = load_rig(rig), own.place, own.heading
    noise, note = pixel_sigma_and_source(own.pixel_sigma, solved)
    if solved.mounting is not None and {"origin", "heading"} <= taken:
        # What the rig was solved with is better known.
        place = heading = None
        err.print("the position of the rig is that in its file, not that in kcal.toml")
    doubts = _warned(rig, solved.calibration.warnings if solved.calibration else ())
    if place is None or heading is None:
        if solved.mounting is None:
            raise InputError(
                f"{rig}: the file has no position of the rig; give --origin and --heading. If you only need meters "
                "from the left camera, the columns east_m, north_m and up_m: "
                + typed_with({}, "--origin", "0,0,0", "--heading", "0")
            )
    elif own.grid is not None:
        heading = true_from_grid(heading, place, own.grid)

    def locator(standing: StereoRig) -> Locator:
        errors = run_errors(
            standing, yaw_deg=yaw_sigma, heading_deg=own.heading_sigma, origin_m=own.origin_sigma,
            elsewhere=place is not None,
        )  # fmt: skip
        return Locator(
            standing, geoid=find_geoid(own.geoid), origin=place, heading_deg=heading, pitch_deg=own.pitch,
            roll_deg=own.roll, pixel_sigma=noise, calibration=errors.calibration, mounting=errors.mounting,
            link=errors.link, refraction=own.refraction, refraction_sigma=own.refraction_sigma,
        )  # fmt: skip

    if own.watch is not None and solved.covariance is None:
        # Not exact: moments add what is not known of them.
        solved.covariance = RigCovariance.of(solved)
    locate = locator(solved)
    by_moments = None if own.watch is None else located_at(own.watch, solved, locator)

    def parts() -> Iterator[LocatedPart]:
        for chunk in read_mark_chunks(points):
            cov = filled(chunk.covariance, noise)
            columns = (by_moments or locate)(chunk.names, chunk.pixels, cov, chunk.extras)
            yield LocatedPart(columns, None, cov is not None, chunk.bytes_read)

    return LocateRun(locate, located_by(locate), parts(), doubts, note)


def _warned(rig: Path, doubts: Sequence[str]) -> Sequence[str]:
    for text in doubts:
        warn(f"{rig}: {text}")
    return doubts
