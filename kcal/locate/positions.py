"""`locate_points`: pixel pairs to positions on the Earth, with everything that is told to a user."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.mounting import Origin
from kcal.lens.rig import RigCovariance, StereoRig
from kcal.locate.cep import circular_error
from kcal.locate.datum import Geoid, geoid_heights
from kcal.locate.geodesy import azimuth_elevation, enu_to_geodetic
from kcal.locate.localizer import Localization, StereoLocalizer
from kcal.locate.stereo import PositionStatus

# A reprojection error of this many sigma is not noise: two different things were marked, or the rig has moved.
_MISMATCH_SIGMAS = 10.0

_STATUS_TEXTS = {
    PositionStatus.OUTSIDE_LENS: "the lens model has no ray for a mark",
    PositionStatus.BEHIND: "the lines of sight cross behind a camera: are the marks the same thing?",
    PositionStatus.NOT_FINITE: "a pixel coordinate is not finite",
    PositionStatus.OUTSIDE_IMAGE: "a mark lies outside its image",
    PositionStatus.BAD_COVARIANCE: "the covariance of the marks is not positive definite",
}


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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Viewpoint:
    """Where a camera of the rig stands and what it sees, for maps.

    Args:
        name: "left" or "right".
        enu: meters; zeros for the left camera.
        geodetic: latitude, longitude in degrees, ellipsoidal WGS84 height in meters.
        azimuths_deg: of the left and right ends of the image's middle row, or None if the lens model has no ray there.
    """

    name: str
    enu: tuple[float, float, float]
    geodetic: tuple[float, float, float]
    azimuths_deg: tuple[float, float] | None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Located:
    """Result of `locate_points`: one position for each pair of marks, in order, and where the rig stood.

    `included` names the errors that intervals and covariances cover; `geoid` is the grid of the geoid heights, None
    without one.
    """

    positions: tuple[Position, ...]
    cameras: tuple[Viewpoint, Viewpoint]
    origin: Origin
    heading_deg: float
    pitch_deg: float
    roll_deg: float
    pixel_sigma: float
    included: tuple[str, ...] = ("marks",)
    geoid: str | None = None

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
        return sum(position.status == PositionStatus.OK for position in self.positions)

    @property
    def enu(self) -> Tensor:
        """East, north, up in meters, (N, 3) float64; NaN where there is no position."""
        nowhere = (math.nan,) * 3
        rows = [nowhere if position.enu is None else position.enu for position in self.positions]
        return torch.tensor(rows, dtype=torch.float64).reshape(-1, 3)


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
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        >>> located = locate_points(rig, torch.tensor([[960.0, 540.0]]), torch.tensor([[944.0, 540.0]]),
        ...                  origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0)
        >>> position = located.positions[0]
        >>> round(position.range_m, 3), round(position.lat, 6), round(position.range_high_m, 1)
        (1000.0, 19.079034, 1054.8)
    """
    device = rig.right_from_left_rotation.device
    pixels_left = as_points("pixels_left", pixels_left, 2).to(device)
    pixels_right = as_points("pixels_right", pixels_right, 2).to(device)
    if pixels_left.ndim != 2:
        raise InputError(f"pixels_left: shape (N, 2) is needed, got {tuple(pixels_left.shape)}")
    if len(pixels_left) == 0:
        raise InputError("pixels_left: no pair of marks; at least one is needed")
    names = [str(i + 1) for i in range(len(pixels_left))] if names is None else list(names)
    if len(names) != len(pixels_left):
        raise InputError(f"names: {len(names)} for {len(pixels_left)} pairs of marks; one each is needed")
    with torch.no_grad():
        localize = StereoLocalizer(
            rig, origin=origin, heading_deg=heading_deg, pitch_deg=pitch_deg, roll_deg=roll_deg,
            pixel_sigma=pixel_sigma, calibration=calibration, mounting=mounting, link=link, refraction=refraction,
            refraction_sigma=refraction_sigma,
        )  # fmt: skip
        slopes = [slope.tolist() for slope in localize.sensitivity(pixels_left, pixels_right)]
        result = Localization(*(tensor.cpu() for tensor in localize(pixels_left, pixels_right, cov)))
        cameras = _viewpoints(rig, localize.enu_from_rig.cpu(), localize.origin)
    heading, pitch, roll = localize.attitude_deg
    angles = azimuth_elevation(result.bearing).tolist()
    circles = circular_error(result.enu, result.covariance).tolist()
    sigmas = [pixel_sigma] * len(names) if cov is None else _marks_sigma(cov, len(names))
    baseline = float(rig.baseline)

    positions = []
    for i, name in enumerate(names):
        status = PositionStatus(int(result.status[i]))
        position = Position(name=name, status=status, reason=_explanation(status, result, i, sigmas[i], baseline))
        if status in (PositionStatus.OK, PositionStatus.BEARING_ONLY, PositionStatus.PARALLEL):
            position = dataclasses.replace(position, azimuth_deg=angles[i][0], elevation_deg=angles[i][1])
            low, high = float(result.range_low[i]), float(result.range_high[i])
            if math.isfinite(low):
                position = dataclasses.replace(position, range_low_m=low, range_high_m=high)
        if status in (PositionStatus.OK, PositionStatus.BEARING_ONLY):
            left, right = result.reprojection[i].tolist()
            position = dataclasses.replace(position, reprojection_px=(left, right))
        if status == PositionStatus.OK:
            position = _placed(position, result, i)
            position = dataclasses.replace(
                position, cep50_m=circles[i][0], cep95_m=circles[i][1], meters_per_pixel=slopes[0][i],
                meters_per_degree=slopes[1][i],
            )  # fmt: skip
        positions.append(position)
    if geoid is not None:
        positions = _with_geoid(positions, geoid)
    return Located(
        positions=tuple(positions),
        cameras=cameras,
        origin=localize.origin,
        heading_deg=heading,
        pitch_deg=pitch,
        roll_deg=roll,
        pixel_sigma=pixel_sigma,
        included=localize.included,
        geoid=None if geoid is None else geoid.name,
    )


def _placed(position: Position, result: Localization, i: int) -> Position:
    east, north, up = result.enu[i].tolist()
    lat, lon, height = result.geodetic[i].tolist()
    first, second, third = (tuple(row) for row in result.covariance[i].tolist())
    return dataclasses.replace(
        position, lat=lat, lon=lon, height=height, enu=(east, north, up), covariance=(first, second, third),
        range_m=float(1.0 / result.inverse_range[i]),
    )  # fmt: skip


def _with_geoid(positions: list[Position], geoid: Geoid) -> list[Position]:
    known = [i for i, position in enumerate(positions) if position.lat is not None]
    places = [(positions[i].lat or 0.0, positions[i].lon or 0.0) for i in known]
    for i, height in zip(known, geoid_heights(geoid, places), strict=True):
        positions[i] = dataclasses.replace(positions[i], geoid_height=height)
    return positions


def _marks_sigma(cov: Tensor, count: int) -> list[float]:
    """The largest standard deviation of each pair's coordinates; infinite where it is not positive."""
    variance = cov.detach().cpu().double().diagonal(dim1=-2, dim2=-1).amax(-1).expand(count)
    return [math.sqrt(value) if value > 0 else math.inf for value in variance.tolist()]


def _explanation(status: PositionStatus, result: Localization, i: int, pixel_sigma: float, baseline: float) -> str:
    if status in _STATUS_TEXTS:
        return _STATUS_TEXTS[status]
    low = float(result.range_low[i])
    if status == PositionStatus.PARALLEL and math.isinf(low):
        angle = math.degrees(math.atan(-baseline * float(result.inverse_range[i])))
        return f"the lines of sight diverge by {angle:.3g}°, more than noise: not the same thing, or the rig has turned"
    if status == PositionStatus.PARALLEL and low == 0:
        return "a mark lies in the direction of the other camera: no range can be measured along that line"
    if status in (PositionStatus.PARALLEL, PositionStatus.BEARING_ONLY):
        return f"the parallax is below three sigma: only the bearing is known, and a range of at least {low:.0f} m"
    worst = float(result.reprojection[i].max())
    if worst > _MISMATCH_SIGMAS * pixel_sigma:
        return (
            f"doubtful: the reprojection error of {worst:.1f} px is too large for noise; are the marks the same thing?"
        )
    return ""


def _viewpoints(rig: StereoRig, enu_from_left: Tensor, origin: Origin) -> tuple[Viewpoint, Viewpoint]:
    rotation, translation = rig.right_from_left_rotation.cpu(), rig.right_from_left_translation.cpu()
    enu_from_right = enu_from_left @ rotation.T
    enu = -enu_from_right @ translation
    lat, lon, height = enu_to_geodetic(enu, origin).tolist()
    here = (origin.lat, origin.lon, origin.height)
    return (
        _viewpoint("left", rig.left, torch.zeros_like(enu), enu_from_left, here),
        _viewpoint("right", rig.right, enu, enu_from_right, (lat, lon, height)),
    )


def _viewpoint(
    name: str, camera: Camera, enu: Tensor, enu_from_camera: Tensor, geodetic: tuple[float, float, float]
) -> Viewpoint:
    width, height = camera.size
    ends = camera.focal.new_tensor([[-0.5, (height - 1) / 2], [width - 0.5, (height - 1) / 2]])
    rays, valid = camera.unproject(ends)
    first, last = azimuth_elevation(rays.cpu() @ enu_from_camera.T)[:, 0].tolist()
    east, north, up = enu.tolist()
    return Viewpoint(
        name=name,
        enu=(east, north, up),
        geodetic=geodetic,
        azimuths_deg=(first, last) if bool(valid.all()) else None,
    )
