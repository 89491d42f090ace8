"""`locate_points`: pixel pairs to positions on the Earth, with everything that is told to a user."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.mounting import Origin
from kcal.lens.rig import RigCovariance, StereoRig
from kcal.locate.columns import NUMBERS, PositionColumns
from kcal.locate.datum import Geoid
from kcal.locate.stereo import PositionStatus, checked_pairs
from kcal.locate.tables import CHUNK_ROWS
from kcal.locate.tabulate import Locator, Viewpoint
from kcal.texts import brief


@dataclasses.dataclass(frozen=True, kw_only=True)
class Position:
    """One pair of marks, located or not; what is not known is None.

    Latitude, longitude (degrees) and the ellipsoidal WGS84 `height` (meters), `enu` and the best estimate `range_m`
    are there only if the status is `OK`. Azimuth and elevation in degrees and the range interval are also there if
    it is `BEARING_ONLY` or `PARALLEL`, the interval only if some range explains the marks. Ranges are meters from the
    left camera; `range_high_m` may be infinite. The interval covers 95 % of the errors that `Located.interval_note`
    names. `reason` is empty, says why there is no position, or warns of one that looks wrong.

    `height` is above the ellipsoid; `geoid_height` is that of the geoid, known only with a grid, and
    `height - geoid_height` is close to the height above the sea. `covariance` is of `enu`, to first order; `cep50_m`
    and `cep95_m` are the radii of horizontal circles that contain the true position with 50 and 95 %, infinite where it
    may lie at infinity. The sensitivities are slopes of the range by a pixel of a mark and by a degree of relative yaw.
    """

    name: str
    status: PositionStatus
    reason: str = ""
    lat: float | None = None
    lon: float | None = None
    height: float | None = None
    geoid_height: float | None = None
    enu: tuple[float, float, float] | None = None
    covariance: tuple[tuple[float, float, float], ...] | None = None
    cep50_m: float | None = None
    cep95_m: float | None = None
    meters_per_pixel: float | None = None
    meters_per_degree: float | None = None
    range_m: float | None = None
    range_low_m: float | None = None
    range_high_m: float | None = None
    azimuth_deg: float | None = None
    elevation_deg: float | None = None
    reprojection_px: tuple[float, float] | None = None


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Located:
    """Result of `locate_points`: one position for each pair of marks, in order, and where the rig stood.

    `columns` contains the positions as arrays, `positions` gives each row as a `Position`.

    `feet` (N, 3) are the places, meters, from which bearings and ranges of the rows count; None: the left camera.

    `included` names the errors that intervals and covariances cover; `geoid` is the grid of the geoid heights, None
    without one. `rows` is the length of the table of which the positions are a sample, None if they are all.
    """

    __repr__ = brief

    columns: PositionColumns
    cameras: tuple[Viewpoint, ...]
    origin: Origin
    heading_deg: float
    pitch_deg: float
    roll_deg: float
    pixel_sigma: float
    included: tuple[str, ...] = ("marks",)
    geoid: str | None = None
    rows: int | None = None
    feet: Tensor | None = None

    @functools.cached_property
    def positions(self) -> tuple[Position, ...]:
        """The rows, one object each."""
        return tuple(_positions_of(self.columns))

    @property
    def count_note(self) -> str:
        """How many points are located, and of how long a table they are a sample."""
        note = f"{self.count} of {len(self.columns.names)} points located"
        return note if self.rows is None else f"{note}, a sample of the {self.rows:,} in the table"

    @property
    def interval_note(self) -> str:
        """Which errors the intervals cover and which they do not, as a sentence without a full stop."""
        missing = [name for name in ("calibration", "mounting") if name not in self.included]
        known = [name for name in self.included if name != "marks"]
        note = "95 % of the noise in the marks" + (f" and of the errors in {' and '.join(known)}" if known else "")
        return note + (f"; errors in {' and '.join(missing)} are not included" if missing else "")

    @property
    def count(self) -> int:
        """How many pairs have a position."""
        return int((self.columns.status == PositionStatus.OK).sum())

    @property
    def enu(self) -> Tensor:
        """East, north, up in meters, (N, 3) float64; NaN where there is no position."""
        first = NUMBERS.index("east_m")
        return torch.from_numpy(self.columns.numbers[:, first : first + 3].copy())


def locate_points(
    rig: StereoRig,
    pixels_left: Tensor,
    pixels_right: Tensor,
    *,
    origin: Origin | None = None,
    heading_deg: float | None = None,
    pitch_deg: float = 0.0,
    roll_deg: float = 0.0,
    pixel_sigma: float = 0.3,
    names: Sequence[str] | None = None,
    cov: Tensor | None = None,
    calibration: RigCovariance | None = None,
    mounting: Tensor | None = None,
    link: Tensor | None = None,
    refraction: float | None = None,
    refraction_sigma: float | None = None,
    geoid: Geoid | None = None,
) -> Located:
    """Positions on the Earth of things marked in both images of a stereo rig.

    Args:
        rig: the calibrated rig; origin, attitude and covariances that are left out are the rig's own, as for
            `StereoLocalizer`.
        pixels_left: (N, 2) marks in the left image, integer coordinates at pixel centers.
        pixels_right: (N, 2) the same things in the right image.
        origin: position of the left camera's projection center.
        heading_deg: of the left camera's optical axis, clockwise from true north; see `enu_from_cam`.
        pitch_deg: of the same axis, positive up.
        roll_deg: of the left camera, positive clockwise as seen from behind.
        pixel_sigma: standard deviation of a mark along each axis, px.
        names: one for each pair; numbered from 1 if left out.
        cov: (N, 4, 4) covariance of each pair's four coordinates, in place of `pixel_sigma`.
        calibration: how well the rig is known.
        mounting: how well origin and attitude are known, see `mounting_covariance`.
        link: how calibration and mounting go together, see `StereoLocalizer`.
        refraction: bending of light as a share of the Earth's curvature, see `StereoLocalizer`.
        refraction_sigma: its standard deviation.
        geoid: a grid from `kcal.locate.datum.find_geoid`.

    Returns:
        A position, or the reason why there is none, for each pair. A pair whose parallax is below three sigma is
        `BEARING_ONLY`: its range would be noise.

    Raises:
        InputError: wrong shapes, dtypes or names, or an angle or sigma out of range.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        >>> located = locate_points(rig, torch.tensor([[960.0, 540.0]]), torch.tensor([[944.0, 540.0]]),
        ...                  origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0)
        >>> position = located.positions[0]
        >>> round(position.range_m, 3), round(position.lat, 6), round(position.range_high_m, 1)
        (1000.0, 19.079034, 1054.8)
    """
    pixels_left, pixels_right = checked_pairs(pixels_left, pixels_right, rig)
    if pixels_left.ndim != 2:
        raise InputError(f"pixels_left: shape (N, 2) is needed, got {tuple(pixels_left.shape)}")
    if len(pixels_left) == 0:
        raise InputError("pixels_left: no pair of marks; at least one is needed")
    names = [str(i + 1) for i in range(len(pixels_left))] if names is None else list(names)
    if len(names) != len(pixels_left):
        raise InputError(f"names: {len(names)} for {len(pixels_left)} pairs of marks; one each is needed")
    locate = Locator(
        rig, geoid=geoid, origin=origin, heading_deg=heading_deg, pitch_deg=pitch_deg, roll_deg=roll_deg,
        pixel_sigma=pixel_sigma, calibration=calibration, mounting=mounting, link=link, refraction=refraction,
        refraction_sigma=refraction_sigma,
    )  # fmt: skip
    pixels = torch.stack([pixels_left, pixels_right], 1)
    if cov is not None:
        cov = cov.expand(len(pixels), 4, 4)
    pieces = [slice(start, start + CHUNK_ROWS) for start in range(0, len(pixels), CHUNK_ROWS)]
    found = [locate(names[piece], pixels[piece], None if cov is None else cov[piece]) for piece in pieces]
    return located_by(locate, PositionColumns.joined(found))


def located_by(locate: Locator, columns: PositionColumns | None = None) -> Located:
    """Positions with what they were located by: where the rig stood, and which errors are covered."""
    heading, pitch, roll = locate.localize.attitude_deg
    return Located(
        columns=columns or PositionColumns.joined([]),
        cameras=locate.cameras,
        origin=locate.localize.origin,
        heading_deg=heading,
        pitch_deg=pitch,
        roll_deg=roll,
        pixel_sigma=locate.localize.pixel_sigma,
        included=locate.localize.included,
        geoid=None if locate.geoid is None else locate.geoid.name,
    )


def _positions_of(columns: PositionColumns) -> Iterator[Position]:
    rows = zip(columns.names, columns.status.tolist(), columns.reasons, columns.numbers.tolist(), strict=True)
    for name, status, reason, numbers in rows:
        lat, lon, height, geoid, distance, low, high, cep50, cep95, by_pixel, by_degree, azimuth, elevation = (
            None if math.isnan(value) else value for value in (*numbers[:4], *numbers[7:10], *numbers[16:22])
        )
        east, north, up = numbers[4:7]
        ee, en, eu, nn, nu, uu = numbers[10:16]
        left, right = numbers[22:]
        yield Position(
            name=name, status=PositionStatus(status), reason=reason, lat=lat, lon=lon, height=height,
            geoid_height=geoid, enu=None if math.isnan(east) else (east, north, up),
            covariance=None if math.isnan(ee) else ((ee, en, eu), (en, nn, nu), (eu, nu, uu)),
            cep50_m=cep50, cep95_m=cep95, meters_per_pixel=by_pixel, meters_per_degree=by_degree,
            range_m=distance, range_low_m=low, range_high_m=high, azimuth_deg=azimuth, elevation_deg=elevation,
            reprojection_px=None if math.isnan(left) else (left, right),
        )  # fmt: skip
