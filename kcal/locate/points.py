"""Marks to positions with everything that is told to a user, and a sample of them for tables, pictures and maps."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from collections.abc import Set as AbstractSet

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.rig import Rig
from kcal.locate.geodesy import anchor, azimuth_elevation, ecef_from_enu_rotation, enu_to_geodetic
from kcal.locate.ground import Ground
from kcal.locate.localizer import Localizer
from kcal.locate.marks import Marks
from kcal.locate.positions import Located
from kcal.locate.stereo import Localization, PositionStatus
from kcal.locate.tables import CHUNK_ROWS, PositionColumns
from kcal.locate.tabulate import Geoid, Group, Viewpoint, geoid_column, middle_row_ends, number_table

# A reprojection error of this many sigma is not noise: two different points were marked, or the rig has moved.
_MISMATCH_SIGMAS = 10.0
_ELSEWHERE = "are the marks the same point?"
_TEXTS = {
    PositionStatus.OUTSIDE_LENS: "the lens model has no ray for a mark",
    PositionStatus.BEHIND: f"the lines of sight cross behind a camera: {_ELSEWHERE}",
    PositionStatus.OUTSIDE_IMAGE: "a mark lies outside its image",
}
_PAIR_TEXTS = _TEXTS | {
    PositionStatus.NOT_FINITE: "a pixel coordinate is not finite",
    PositionStatus.BAD_COVARIANCE: "the covariance of the marks is not positive definite",
}
_VIEW_TEXTS = _TEXTS | {
    PositionStatus.BEARING_ONLY: (
        "only the bearing is known: one camera, a height out of its reach, or a parallax below three sigma"
    ),
    PositionStatus.PARALLEL: f"the lines of sight do not meet before the cameras: {_ELSEWHERE}",
    PositionStatus.NOT_FINITE: "no camera has a mark",
    PositionStatus.CONTRADICTION: "the marks are not of one point, and which is wrong cannot be told",
}


def locate_points(
    rig: Rig | Localizer,
    marks: Marks,
    *,
    height: tuple[float, float] | None = None,
    ground: Ground | None = None,
    geoid: Geoid | None = None,
) -> Located:
    """Positions of points that are marked in the images of a rig.

    Where all errors weigh, further columns tell which cameras a position is from (`cameras`), which was left out
    because it contradicts the others (`left_out`), and what leaving out each changes (`misfit_sigmas`). Ranges,
    azimuths and elevations are then those from the first camera of a row, at its own vertical.

    Args:
        rig: the calibrated rig; or a `Localizer`, for another place, other errors or other weights.
        marks: in the order of its cameras, such as those of `read_marks`.
        height: meters above the ellipsoid, and its sigma, of what one camera alone saw; with `ground` the first is not
            read, and the second is the ground's.
        ground: on which such points stand, from `level_ground` or `terrain`.
        geoid: a grid from `find_geoid`.

    Returns:
        A position, or the reason why there is none, for each row. A row whose parallax is below three sigma is
        `BEARING_ONLY`: its range would be noise. Of a rig without a place on the Earth, positions are meters in its
        own frame.

    Raises:
        InputError: marks of another number of cameras, or none; a height where it is not used.

    Example:
        >>> from kcal import Camera, Origin
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        >>> marks = Marks(("mast",), torch.tensor([[[960.0, 540.0], [944.0, 540.0]]]))
        >>> localize = Localizer(rig.placed(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0))
        >>> position = locate_points(localize, marks).positions[0]
        >>> round(position.range_m, 3), round(position.lat, 6), round(position.range_high_m, 1)
        (1000.0, 19.079034, 1054.8)
        >>> [round(value) for value in locate_points(rig, marks).positions[0].enu]  # in the left camera's frame
        [0, 0, 1000]
    """
    localize = rig if isinstance(rig, Localizer) else Localizer(rig)
    locate, count = PointLocator(localize, height=height, ground=ground, geoid=geoid), len(localize.rig)
    if marks.pixels.ndim != 3 or marks.pixels.shape[1:] != (count, 2):
        raise InputError(f"marks: pixels (N, {count}, 2) are needed, got {tuple(marks.pixels.shape)}")
    if not len(marks.pixels):
        raise InputError("marks: no row of marks; at least one is needed")
    if len(marks.names) != len(marks.pixels):
        raise InputError(f"marks: {len(marks.names)} names for {len(marks.pixels)} rows; one each is needed")
    starts = range(0, len(marks.names), CHUNK_ROWS)
    return locate.located(PositionColumns.joined([locate(marks.rows(slice(i, i + CHUNK_ROWS))) for i in starts]))


class PointLocator:
    """`locate_points` for one part of a long table after the other.

    Args:
        localize: what locates them.
        height: see `locate_points`.
        ground: likewise.
        geoid: likewise.
    """

    def __init__(
        self,
        localize: Localizer,
        *,
        height: tuple[float, float] | None = None,
        ground: Ground | None = None,
        geoid: Geoid | None = None,
    ) -> None:
        self.localize, self.height, self.ground, self.geoid = localize, height, ground, geoid
        if height is not None or ground is not None:
            if localize.weights == "marks":
                raise InputError('height: a rig of two cameras uses it with weights="all"')
            if not localize.on_earth:
                raise InputError("height: this rig has no place on the Earth; solve it with landmarks or positions")
        with torch.no_grad():
            self.cameras = camera_views(localize)
            self.buried = [] if ground is None else _buried(self.cameras, ground)

    @torch.no_grad()
    def __call__(self, marks: Marks) -> PositionColumns:
        """The columns of some rows."""
        return self._of_pairs(marks) if self.localize.weights == "marks" else self._of_views(marks)

    def _of_pairs(self, marks: Marks) -> PositionColumns:
        localize, count = self.localize, len(marks.names)
        cov = marks.covariance_or(float(localize.pixel_sigma))
        left, right = marks.pixels.to(localize.pixel_sigma.device).unbind(1)
        if cov is None:
            found, slopes = localize.with_sensitivity(left, right)
            sigmas = np.full(count, float(localize.pixel_sigma))
        else:
            found, slopes = localize(left, right, cov.to(left.device)), localize.sensitivity(left, right)
            variance = cov.diagonal(dim1=-2, dim2=-1).amax(-1).numpy()
            sigmas = np.sqrt(np.where(variance > 0, variance, np.inf))
        found = Localization(*(value.cpu() for value in found))
        ok = (found.status == int(PositionStatus.OK)).numpy()
        weak = (found.status == int(PositionStatus.BEARING_ONLY)).numpy()
        numbers = self._numbers(found, [
            ("range_m_per_px", ok, np.stack([value.cpu().numpy() for value in slopes])),
            ("reprojection_left_px", ok | weak, found.reprojection.T.numpy()),
        ])  # fmt: skip
        reasons = [""] * count
        doubtful = found.reprojection.amax(-1).numpy() > _MISMATCH_SIGMAS * sigmas
        baseline = float(localize.rig.baseline)
        apart = (found.status == int(PositionStatus.PARALLEL)) & found.range_low.isinf()
        # Of rows of one mistake, most diverge, and all of these meet the other way round.
        exchanged = 2 * int(apart.sum()) > count and bool(
            (localize(right[apart], left[apart]).status == int(PositionStatus.OK)).all()
        )
        for i in np.flatnonzero(~ok | doubtful).tolist():
            reasons[i] = _pair_reason(PositionStatus(int(found.status[i])), found, i, baseline, exchanged)
        return _as_columns(marks, found, reasons, numbers)

    def _of_views(self, marks: Marks) -> PositionColumns:
        rig, cov = self.localize.rig, None
        if marks.sigma is not None or marks.covariance is not None:
            sigma = marks.sigmas(float(self.localize.pixel_sigma))
            cov = sigma.square()[..., None, None] * torch.eye(2, dtype=torch.float64)
        stated: Tensor | Ground | None = self.ground
        if self.ground is None and self.height is not None:
            stated = torch.full((len(marks.names),), self.height[0], dtype=torch.float64)
        height_sigma = 1.0 if self.height is None else self.height[1]
        found = self.localize(marks.pixels, cov=cov, height=stated, height_sigma=height_sigma)
        own = found
        if rig.origin is not None:
            own = found._replace(bearing=(own_axes(rig)[found.anchor] @ found.bearing[..., None])[..., 0])
        extras = {
            "cameras": [camera_list(rig, row) for row in found.used.tolist()],
            "left_out": [camera_list(rig, row) for row in found.bad.tolist()],
            "misfit_sigmas": [
                " ".join(f"{name}={value:.1f}" for name, value in zip(rig.names, row, strict=True) if value > 0)
                for row in found.misfit.tolist()
            ],
        }
        return _as_columns(marks, found, _view_reasons(rig, found, self.buried), self._numbers(own, []), extras)

    def _numbers(self, found: Localization, more: Sequence[Group]) -> NDArray[np.float64]:
        ok = (found.status == int(PositionStatus.OK)).numpy()
        geodetic, geoid = found.geodetic.numpy(), np.full(len(ok), np.nan)
        if self.geoid is not None and self.localize.on_earth:
            geoid[ok] = geoid_column(self.geoid, geodetic[ok, 0], geodetic[ok, 1])
        return number_table(found, [("geoid_height_m", ok, geoid[None]), *more], on_earth=self.localize.on_earth)

    def located(self, columns: PositionColumns | None = None) -> Located:
        """Positions with what they were located by: where the rig stood, and which errors are covered."""
        localize = self.localize
        heading, pitch, roll = localize.attitude_deg if localize.on_earth else (math.nan,) * 3
        return Located(
            columns=columns or PositionColumns.joined([]),
            cameras=self.cameras,
            origin=localize.origin,
            heading_deg=heading,
            pitch_deg=pitch,
            roll_deg=roll,
            pixel_sigma=float(localize.pixel_sigma),
            included=localize.included,
            geoid=None if self.geoid is None else self.geoid.name,
            centers=localize.rig.center.detach().cpu() if localize.weights == "all" else None,
        )


def _as_columns(
    marks: Marks, found: Localization, reasons: list[str], numbers: NDArray[np.float64],
    extras: dict[str, list[str]] | None = None,
) -> PositionColumns:  # fmt: skip
    status, anchor = found.status.numpy(), found.anchor.numpy()
    return PositionColumns(marks.names, status, reasons, numbers, {**marks.extras, **(extras or {})}, anchor)


def own_axes(rig: Rig) -> Tensor:
    """(V, 3, 3) from the frame of a rig that has an origin to east, north, up of each camera."""
    assert rig.origin is not None
    base = anchor(rig.origin)[0]
    geodetic = enu_to_geodetic(rig.center, rig.origin).tolist()
    return torch.stack([ecef_from_enu_rotation(lat, lon).T @ base for lat, lon, _ in geodetic])


def camera_poses(localize: Localizer) -> tuple[Tensor, Tensor]:
    """Centers (V, 3) of the cameras and their axes (V, 3, 3), columns, in the frame of the positions."""
    center, axes = localize.rig.center.cpu(), localize.rig.rotation.mT.cpu()
    if localize.weights == "all":
        return center, axes
    look = localize.enu_from_rig.cpu()
    return center @ look.T, look @ axes


def camera_views(localize: Localizer) -> tuple[Viewpoint, ...]:
    """Where the cameras of a rig stand and what they see, for maps; none where it has no place on the Earth."""
    origin, rig = localize.origin, localize.rig
    if origin is None:
        return ()
    center, enu_from_cam = camera_poses(localize)
    geodetic = enu_to_geodetic(center, origin).tolist()
    if localize.weights == "marks":
        geodetic[0] = origin.geodetic.tolist()
    views = []
    for name, camera, enu, look, place in zip(rig.names, rig.each, center, enu_from_cam, geodetic, strict=True):
        ends = middle_row_ends(camera)
        azimuths = None if ends is None else tuple(azimuth_elevation(ends @ look.T)[:, 0].tolist())
        views.append(Viewpoint(name=name, enu=tuple(enu.tolist()), geodetic=tuple(place), azimuths_deg=azimuths))
    return tuple(views)


def _buried(cameras: Sequence[Viewpoint], ground: Ground) -> list[str]:
    """For each camera why its lines of sight may never meet the ground; empty where nothing is wrong."""
    lat, lon, height = torch.tensor([camera.geodetic for camera in cameras], dtype=torch.float64).mT
    texts = []
    for camera, depth in zip(cameras, (ground(lat, lon) - height).tolist(), strict=True):
        why = f"stands {depth:.1f} m below the terrain: is its height above the ellipsoid, as the terrain's is?"
        if math.isnan(depth):
            why = "stands where the terrain has no height: does the terrain cover its latitude and longitude?"
        texts.append(f"only the bearing is known: camera {camera.name} {why}" if not depth <= 0 else "")
    return texts


def _pair_reason(status: PositionStatus, found: Localization, i: int, baseline: float, exchanged: bool) -> str:
    if status in _PAIR_TEXTS:
        return _PAIR_TEXTS[status]
    low = float(found.range_low[i])
    if status == PositionStatus.PARALLEL and math.isinf(low):
        angle = math.degrees(math.atan(-baseline * float(found.inverse_range[i])))
        text = f"the lines of sight diverge by {angle:.3g}°, more than noise"
        if exchanged:
            return f"{text}, and meet with left and right exchanged, in all such rows: exchange columns or images"
        return f"{text}: not the same point, or the rig has turned"
    if status == PositionStatus.PARALLEL and low == 0:
        return "a mark lies in the direction of the other camera: no range can be measured along that line"
    if status in (PositionStatus.PARALLEL, PositionStatus.BEARING_ONLY):
        return f"the parallax is below three sigma: only the bearing is known, and a range of at least {low:.0f} m"
    worst = float(found.reprojection[i].max())
    return f"doubtful: the reprojection error of {worst:.1f} px is too large for noise; {_ELSEWHERE}"


def camera_list(rig: Rig, which: Sequence[bool]) -> str:
    """The names of some cameras, with blanks between."""
    return " ".join(name for name, one in zip(rig.names, which, strict=True) if one)


def _view_reasons(rig: Rig, found: Localization, buried: Sequence[str]) -> list[str]:
    reasons = []
    columns = found.status, found.bad, found.misfit, found.used
    for status, bad, misfit, used in zip(*(column.tolist() for column in columns), strict=True):
        text = _VIEW_TEXTS.get(PositionStatus(status), "")
        if buried and status == PositionStatus.BEARING_ONLY and sum(used) == 1:
            text = buried[used.index(True)] or text
        if any(bad):
            worst = max(value for value, one in zip(misfit, bad, strict=True) if one)
            text = f"left out: the mark in {camera_list(rig, bad)} contradicts the others ({worst:.0f} sigma); {text}"
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
        self.count = 0
        self._statuses = np.zeros(len(PositionStatus), dtype=np.int64)

    def add(self, columns: PositionColumns) -> None:
        """Count the next rows, and keep some."""
        numbers = np.arange(self.count, self.count + len(columns.names))
        self.count += len(numbers)
        self._statuses += np.bincount(columns.status, minlength=len(self._statuses))
        while self.count > self._stride * self._most:
            self._stride *= 2
        parts = [self._wanted(self._numbers, self._kept), self._wanted(numbers, columns._replace(extras={}))]
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

    def located(self, locate: PointLocator) -> Located:
        """What was kept, in the order of the table."""
        found = locate.located(self._kept)
        return found if len(self._numbers) == self.count else dataclasses.replace(found, rows=self.count)
