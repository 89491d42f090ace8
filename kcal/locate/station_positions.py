"""Marks of any number of cameras to positions on the Earth, and a sample of them for tables, pictures and maps."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from collections.abc import Set as AbstractSet

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.rig import Rig
from kcal.locate.geodesy import anchor, ecef_from_enu_rotation, enu_to_geodetic
from kcal.locate.ground import Ground
from kcal.locate.localizer import Localization
from kcal.locate.marks import Marks
from kcal.locate.multi_localizer import MultiViewLocalizer, ViewsLocalization
from kcal.locate.positions import Located, located_by
from kcal.locate.stations import station_mounting
from kcal.locate.stereo import PositionStatus
from kcal.locate.tables import NUMBERS, PositionColumns
from kcal.locate.tabulate import Geoid, Locator, geoid_column, number_table, viewpoint

# Marks of any number of cameras to positions on the Earth, with everything that is told to a user.

_TEXTS = {
    PositionStatus.BEARING_ONLY: "only the bearing is known: one camera, or a parallax below three sigma",
    PositionStatus.PARALLEL: "the lines of sight do not meet before the cameras: are the marks the same thing?",
    PositionStatus.BEHIND: "the lines of sight cross behind a camera: are the marks the same thing?",
    PositionStatus.OUTSIDE_LENS: "the lens model has no ray for a mark",
    PositionStatus.OUTSIDE_IMAGE: "a mark lies outside its image",
    PositionStatus.NOT_FINITE: "no camera has a mark",
    PositionStatus.CONTRADICTION: "the marks are not of one thing, and which is wrong cannot be told",
}


@torch.no_grad()
def locate_views(
    rig: Rig,
    views: Marks,
    *,
    pixel_sigma: float = 0.3,
    height: tuple[float, float] | None = None,
    ground: Ground | None = None,
    geoid: Geoid | None = None,
) -> Located:
    """Positions of things that any of a rig's cameras saw.

    Further columns tell which cameras a position is from (`cameras`), which was left out because it contradicts the
    others (`left_out`), and what leaving out each changes (`misfit_sigmas`). Ranges, azimuths and elevations are those
    from the first camera of a row, at its own vertical.

    Args:
        rig: with an origin.
        views: marks, in the order of the rig's cameras.
        pixel_sigma: of a mark along each axis, px, where the table does not say.
        height: meters above the ellipsoid, and its sigma, of what one camera alone saw; with `ground` the first is not
            read, and the second is the ground's.
        ground: on which such things stand, from `level_ground` or `terrain`.
        geoid: a grid from `kcal.locate.tabulate.find_geoid`.

    Raises:
        InputError: a rig without a place on the Earth.

    Example:
        >>> from kcal import Camera, Origin
        >>> from kcal.locate import enu_from_cam
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> look = torch.stack([enu_from_cam(heading).T for heading in (0.0, 315.0)])
        >>> rig = Rig([camera] * 2, ["mill", "mast"], look, center=torch.tensor([[0.0, 0, 30], [5000, 0, 30]]),
        ...                 origin=Origin(lat=45.0, lon=6.0, height=0.0), refraction=0.0)
        >>> pixels, _ = rig(torch.tensor([[100.0, 5000, 60]]))
        >>> views = Marks(("smoke",), pixels, sigma=torch.full((1, 2), 2.0))
        >>> located = locate_views(rig, views).positions[0]
        >>> [round(value) for value in located.enu], located.status.name
        ([100, 5000, 60], 'OK')
    """
    locate = ViewsLocator(rig, pixel_sigma=pixel_sigma, height=height, ground=ground, geoid=geoid)
    return locate.located(*locate(views))


class ViewsLocator:
    """`locate_views` for one part of a long table after the other; the arguments are the same."""

    def __init__(
        self,
        rig: Rig,
        *,
        pixel_sigma: float = 0.3,
        height: tuple[float, float] | None = None,
        ground: Ground | None = None,
        geoid: Geoid | None = None,
    ) -> None:
        if rig.origin is None:
            raise InputError(
                "this rig has no place on the Earth: solve it with landmarks or positions that have latitudes"
            )
        self.rig, self.origin, self.geoid = rig, rig.origin, geoid
        self.localize = MultiViewLocalizer(rig, pixel_sigma=pixel_sigma)
        self.height, self.ground, self.to_own = height, ground, own_axes(rig)

    @torch.no_grad()
    def __call__(self, views: Marks) -> tuple[PositionColumns, Tensor]:
        """The columns of some rows, and (N, 3) where their bearings and ranges count from."""
        rig, cov = self.rig, None
        if views.sigma is not None or views.covariance is not None:
            sigma = views.sigmas(float(self.localize.pixel_sigma))
            cov = sigma.square()[..., None, None] * torch.eye(2, dtype=torch.float64)
        stated: Tensor | Ground | None = self.ground
        if self.ground is None and self.height is not None:
            stated = torch.full((len(views.names),), self.height[0], dtype=torch.float64)
        found = self.localize(
            views.pixels,
            cov=cov,
            height=stated,
            height_sigma=1.0 if self.height is None else self.height[1],
        )
        bearing = (self.to_own[found.anchor] @ found.bearing[..., None])[..., 0]
        as_pairs = Localization(
            enu=found.enu, covariance=found.covariance, geodetic=found.geodetic, range_low=found.range_low,
            range_high=found.range_high, status=found.status, bearing=bearing, inverse_range=found.inverse_range,
            inverse_range_sigma=found.inverse_range_sigma, reprojection=found.reprojection[:, :2],
        )  # fmt: skip
        ok = (found.status == int(PositionStatus.OK)).numpy()
        heights = np.full(len(ok), np.nan)
        if self.geoid is not None:
            heights[ok] = geoid_column(self.geoid, found.geodetic[ok, 0].numpy(), found.geodetic[ok, 1].numpy())
        numbers = number_table(as_pairs, (("geoid_height_m", ok, heights[None]),))
        extras = dict(views.extras) | {
            "cameras": [_camera_list(rig, row) for row in found.used.tolist()],
            "left_out": [_camera_list(rig, row) for row in found.bad.tolist()],
            "misfit_sigmas": [_misfits(rig, row) for row in found.misfit.tolist()],
        }
        columns = PositionColumns(views.names, found.status.numpy(), _row_reasons(rig, found), numbers, extras)
        return columns, rig.center[found.anchor]

    def located(self, columns: PositionColumns | None = None, feet: Tensor | None = None) -> Located:
        """Positions with what they were located by; none where only that is asked for."""
        none = torch.zeros(0, 3, dtype=torch.float64)
        return dataclasses.replace(
            stations_head(self.localize), columns=PositionColumns.joined([]) if columns is None else columns,
            geoid=None if self.geoid is None else self.geoid.name, feet=none if feet is None else feet,
        )  # fmt: skip


def own_axes(rig: Rig) -> Tensor:
    """(V, 3, 3) from the frame of a rig that has an origin to east, north, up of each camera."""
    assert rig.origin is not None
    base = anchor(rig.origin)[0]
    geodetic = enu_to_geodetic(rig.center, rig.origin).tolist()
    return torch.stack([ecef_from_enu_rotation(lat, lon).T @ base for lat, lon, _ in geodetic])


def stations_head(localize: MultiViewLocalizer) -> Located:
    """No positions, and where the cameras of a rig stand that has an origin."""
    rig, empty = localize.rig, torch.zeros(0, dtype=torch.int8)
    assert rig.origin is not None
    first, geodetic = station_mounting(rig, 0), enu_to_geodetic(rig.center, rig.origin)
    return Located(
        columns=PositionColumns((), empty.numpy(), [], np.zeros((0, len(NUMBERS))), {}),
        cameras=tuple(
            viewpoint(name, camera, center, turn.T, tuple(place))
            for name, camera, center, turn, place in zip(
                rig.names, rig.each, rig.center, rig.rotation, geodetic.tolist(), strict=True
            )
        ),
        origin=rig.origin,
        heading_deg=first.heading_deg,
        pitch_deg=first.pitch_deg,
        roll_deg=first.roll_deg,
        pixel_sigma=float(localize.pixel_sigma),
        included=("marks",) if localize.errors is None else ("marks", "calibration", "mounting"),
        feet=torch.zeros(0, 3, dtype=torch.float64),
    )


def _camera_list(rig: Rig, which: Sequence[bool]) -> str:
    return " ".join(name for name, one in zip(rig.names, which, strict=True) if one)


def _misfits(rig: Rig, row: Sequence[float]) -> str:
    return " ".join(f"{name}={value:.1f}" for name, value in zip(rig.names, row, strict=True) if value > 0)


def _row_reasons(rig: Rig, found: ViewsLocalization) -> list[str]:
    reasons = []
    rows = zip(found.status.tolist(), found.bad.tolist(), found.misfit.tolist(), strict=True)
    for status, bad, misfit in rows:
        text = _TEXTS.get(PositionStatus(status), "")
        if any(bad):
            worst = max(value for value, one in zip(misfit, bad, strict=True) if one)
            text = f"left out: the mark in {_camera_list(rig, bad)} contradicts the others ({worst:.0f} sigma); {text}"
        reasons.append(text.removesuffix("; "))
    return reasons


# Count the rows of a long table, and keep some of them for tables on a screen, pictures and maps.

# More than anybody reads, and few enough for a picture and a page.
SAMPLE_ROWS = 1000


class PositionSample:
    """Evenly spaced rows, at most `most` of them, whatever the chunks; tables no longer than that are kept whole.

    Args:
        named: names whose rows are kept besides.
        most: how many others at most.
    """

    def __init__(self, named: AbstractSet[str] = frozenset(), most: int = SAMPLE_ROWS) -> None:
        self._named, self._most = named, most
        self._stride = 1
        self._numbers, self._kept = np.zeros(0, dtype=np.int64), PositionColumns.joined([])
        self._feet = torch.zeros(0, 3, dtype=torch.float64)
        self.count = 0
        self._statuses = np.zeros(len(PositionStatus), dtype=np.int64)

    def add(self, columns: PositionColumns, feet: Tensor | None = None) -> None:
        """Count the next rows, and keep some, with where their bearings count from, (N, 3), of several cameras."""
        numbers = np.arange(self.count, self.count + len(columns.names))
        self.count += len(numbers)
        self._statuses += np.bincount(columns.status, minlength=len(self._statuses))
        while self.count > self._stride * self._most:
            self._stride *= 2
        parts = [self._wanted(self._numbers, self._kept), self._wanted(numbers, columns._replace(extras={}))]
        if feet is not None:
            whole = torch.cat([self._feet, feet])
            self._feet = whole[np.isin(np.concatenate([self._numbers, numbers]), [*parts[0][0], *parts[1][0]])]
        self._numbers = np.concatenate([which for which, _ in parts])
        self._kept = PositionColumns.joined([rows for _, rows in parts])

    def _wanted(
        self, numbers: NDArray[np.int64], columns: PositionColumns
    ) -> tuple[NDArray[np.int64], PositionColumns]:
        wanted = numbers % self._stride == 0
        if self._named:
            wanted |= np.array([name in self._named for name in columns.names], dtype=bool)
        return numbers[wanted], columns.rows(np.flatnonzero(wanted))

    @property
    def statuses(self) -> dict[str, int]:
        """How many rows have each status; the ones that occur."""
        return {status.name.lower(): int(self._statuses[status]) for status in PositionStatus if self._statuses[status]}

    def located(self, locate: Locator | ViewsLocator) -> Located:
        """What was kept, in the order of the table."""
        if isinstance(locate, ViewsLocator):
            found = locate.located(self._kept, self._feet)
        else:
            found = located_by(locate, self._kept)
        return found if len(self._numbers) == self.count else dataclasses.replace(found, rows=self.count)
