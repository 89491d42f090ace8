"""`Locator`: arrays of marks to columns of positions, for tables of any length."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.lens.camera import Camera
from kcal.lens.mounting import Origin
from kcal.lens.rig import StereoRig
from kcal.locate.cep import circular_error
from kcal.locate.columns import NUMBERS, PositionColumns
from kcal.locate.datum import Geoid, geoid_column
from kcal.locate.geodesy import azimuth_elevation, enu_to_geodetic
from kcal.locate.localizer import Localization, Sensitivity, StereoLocalizer
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
class Viewpoint:
    """Where a camera of the rig stands and what it sees, for maps.

    Args:
        name: "left" or "right", or that of a station.
        enu: meters from the origin.
        geodetic: latitude, longitude in degrees, ellipsoidal WGS84 height in meters.
        azimuths_deg: of the left and right ends of the image's middle row, or None if the lens model has no ray there.
    """

    name: str
    enu: tuple[float, float, float]
    geodetic: tuple[float, float, float]
    azimuths_deg: tuple[float, float] | None


class Locator:
    """Locate pairs of marks, and collect all that is told to a user in columns.

    Args:
        rig: the calibrated rig.
        geoid: a grid from `kcal.locate.datum.find_geoid`.
        options: of `StereoLocalizer`.
    """

    def __init__(self, rig: StereoRig, *, geoid: Geoid | None = None, **options: Any) -> None:
        self.localize = StereoLocalizer(rig, **options)
        self.geoid = geoid
        with torch.no_grad():
            self.cameras = _viewpoints(rig, self.localize.enu_from_rig.cpu(), self.localize.origin)

    @torch.no_grad()
    def __call__(
        self,
        names: Sequence[str],
        pixels: Tensor,
        cov: Tensor | None = None,
        extras: dict[str, list[str]] | None = None,
    ) -> PositionColumns:
        """Locate some thousand pairs at once.

        Args:
            names: one for each pair.
            pixels: (N, 2, 2) marks in the left and the right image.
            cov: (N, 4, 4) covariance of each pair's four coordinates.
            extras: cells of further columns.
        """
        left, right = pixels.to(self.localize.rig.right_from_left_rotation.device).unbind(1)
        if cov is None:
            found, slopes = self.localize.with_sensitivity(left, right)
        else:
            found, slopes = self.localize(left, right, cov), self.localize.sensitivity(left, right)
        found = Localization(*(value.cpu() for value in found))
        numbers = self._numbers(found, Sensitivity(*(value.cpu() for value in slopes)))
        sigmas = np.full(len(names), self.localize.pixel_sigma) if cov is None else _marks_sigma(cov, len(names))
        reasons = self._reasons(found, sigmas)
        return PositionColumns(names, found.status.numpy(), reasons, numbers, extras or {})

    def _numbers(self, found: Localization, slopes: Sensitivity) -> NDArray[np.float64]:
        ok = (found.status == int(PositionStatus.OK)).numpy()
        weak = (found.status == int(PositionStatus.BEARING_ONLY)).numpy()
        geodetic, geoid = found.geodetic.numpy(), np.full(len(ok), np.nan)
        if self.geoid is not None:
            geoid[ok] = geoid_column(self.geoid, geodetic[ok, 0], geodetic[ok, 1])
        return number_table(found, (
            ("geoid_height_m", ok, geoid[None]),
            ("range_m_per_px", ok, np.stack([value.numpy() for value in slopes])),
            ("reprojection_left_px", ok | weak, found.reprojection.T.numpy()),
        ))  # fmt: skip

    def _reasons(self, found: Localization, sigmas: NDArray[np.float64]) -> list[str]:
        reasons = [""] * len(sigmas)
        status, worst = found.status.numpy(), found.reprojection.amax(-1).numpy()
        doubtful = worst > _MISMATCH_SIGMAS * sigmas
        baseline = float(self.localize.rig.baseline)
        for i in np.flatnonzero((status != int(PositionStatus.OK)) | doubtful).tolist():
            reasons[i] = _explanation(PositionStatus(int(status[i])), found, i, baseline)
        return reasons


Group = tuple[str, NDArray[np.bool_], NDArray[np.float64]]


def number_table(found: Localization, more: Sequence[Group] = ()) -> NDArray[np.float64]:
    """(N, 24) the columns `NUMBERS` of localized pairs or tracks on the CPU; NaN where unknown.

    Args:
        found: (N,) of them; the reprojection is not read.
        more: other columns: name of the first, (N,) where they are known, and values (columns, N).
    """
    status = found.status
    ok = (status == int(PositionStatus.OK)).numpy()
    aimed = ok | torch.isin(status, status.new_tensor([PositionStatus.BEARING_ONLY, PositionStatus.PARALLEL])).numpy()
    circles = torch.full((len(ok), 2), math.nan, dtype=torch.float64)
    circles[torch.from_numpy(ok)] = circular_error(found.enu[ok], found.covariance[ok])
    interval = torch.stack([found.range_low, found.range_high])
    groups: tuple[Group, ...] = (
        ("lat", ok, found.geodetic.T.numpy()),
        ("east_m", ok, found.enu.T.numpy()),
        ("range_m", ok, 1.0 / np.where(ok, found.inverse_range.numpy(), 1.0)[None]),
        ("range_low_m", aimed & torch.isfinite(found.range_low).numpy(), interval.numpy()),
        ("cov_ee_m2", ok, found.covariance[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].T.numpy()),
        ("cep50_m", ok, circles.T.numpy()),
        ("azimuth_deg", aimed, azimuth_elevation(found.bearing).T.numpy()),
        *more,
    )
    table = np.full((len(NUMBERS), len(ok)), np.nan)
    for first, where, values in groups:
        row = NUMBERS.index(first)
        np.copyto(table[row : row + len(values)], values, where=where)
    return np.ascontiguousarray(table.T)


def _marks_sigma(cov: Tensor, count: int) -> NDArray[np.float64]:
    """The largest standard deviation of each pair's coordinates; infinite where it is not positive."""
    variance = cov.detach().cpu().double().diagonal(dim1=-2, dim2=-1).amax(-1).expand(count).numpy()
    return np.sqrt(np.where(variance > 0, variance, np.inf))


def _explanation(status: PositionStatus, found: Localization, i: int, baseline: float) -> str:
    if status in _STATUS_TEXTS:
        return _STATUS_TEXTS[status]
    low = float(found.range_low[i])
    if status == PositionStatus.PARALLEL and math.isinf(low):
        angle = math.degrees(math.atan(-baseline * float(found.inverse_range[i])))
        return f"the lines of sight diverge by {angle:.3g}°, more than noise: not the same thing, or the rig has turned"
    if status == PositionStatus.PARALLEL and low == 0:
        return "a mark lies in the direction of the other camera: no range can be measured along that line"
    if status in (PositionStatus.PARALLEL, PositionStatus.BEARING_ONLY):
        return f"the parallax is below three sigma: only the bearing is known, and a range of at least {low:.0f} m"
    worst = float(found.reprojection[i].max())
    return f"doubtful: the reprojection error of {worst:.1f} px is too large for noise; are the marks the same thing?"


def _viewpoints(rig: StereoRig, enu_from_left: Tensor, origin: Origin) -> tuple[Viewpoint, Viewpoint]:
    rotation, translation = rig.right_from_left_rotation.cpu(), rig.right_from_left_translation.cpu()
    enu_from_right = enu_from_left @ rotation.T
    enu = -enu_from_right @ translation
    lat, lon, height = enu_to_geodetic(enu, origin).tolist()
    here = (origin.lat, origin.lon, origin.height)
    return (
        viewpoint("left", rig.left, torch.zeros_like(enu), enu_from_left, here),
        viewpoint("right", rig.right, enu, enu_from_right, (lat, lon, height)),
    )


def viewpoint(
    name: str, camera: Camera, enu: Tensor, enu_from_camera: Tensor, geodetic: tuple[float, float, float]
) -> Viewpoint:
    """Where a camera stands and what it sees, given its center (3,), attitude (3, 3) and place on the Earth."""
    ends = middle_row_ends(camera)
    east, north, up = enu.tolist()
    return Viewpoint(
        name=name,
        enu=(east, north, up),
        geodetic=geodetic,
        azimuths_deg=None if ends is None else tuple(azimuth_elevation(ends @ enu_from_camera.T)[:, 0].tolist()),
    )


def middle_row_ends(camera: Camera) -> Tensor | None:
    """Rays (2, 3) through the left and right ends of the image's middle row, on the CPU; None where there are none."""
    width, height = camera.size
    ends = camera.focal.new_tensor([[-0.5, (height - 1) / 2], [width - 0.5, (height - 1) / 2]])
    with torch.no_grad():
        rays, valid = camera.unproject(ends)
    return rays.cpu() if bool(valid.all()) else None
