"""What a rig is solved from: boards, landmarks, features, baselines, skylines and stars."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.problem.views import whitening
from kcal.checks import as_points, require_finite
from kcal.corners.board import Board
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.texts import brief

# What skylines tell of a rig: attitudes of its cameras, with the errors that they share, as one Gaussian.


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class SkylineSource:
    """What the skylines in images of a rig tell of where its cameras look.

    They are one Gaussian, near the attitudes that fit the skylines alone: images of one camera, and cameras that stand
    side by side, share the errors of the terrain raster and of refraction. `kcal.rig.skyline_source` makes it.

    Args:
        cameras: number of the camera of each image.
        names: of the images.
        rotation: (C, 3, 3) cam_from_world by the skyline alone; NaN for cameras without one.
        center: (C, 3) meters where the cameras were taken to be; NaN likewise.
        parameters: (C) parameters of each camera's lens, as they were taken to be.
        rows: (Q, 6 C + P) whitened derivatives by turns of the cameras about their own axes, by their centers, and by
            the parameters of all lenses one after the other.
        residual: (Q,) whitened, there.
        columns: (I,) columns of each image that were used.
        rms_px: (I,) of their residuals.
        sigmas: (I,) root of χ² over the degrees of freedom of each image, by its skyline alone.

    Raises:
        InputError: shapes that do not fit each other.
    """

    __repr__ = brief

    cameras: tuple[int, ...]
    names: tuple[str, ...]
    rotation: Tensor
    center: Tensor
    parameters: tuple[Tensor, ...]
    rows: Tensor
    residual: Tensor
    columns: tuple[int, ...]
    rms_px: tuple[float, ...]
    sigmas: tuple[float, ...]

    def __post_init__(self) -> None:
        count, lens = len(self.rotation), sum(map(len, self.parameters))
        if self.center.shape != (count, 3) or len(self.parameters) != count:
            raise InputError("skyline: a rotation, a center and parameters for each camera are needed")
        if self.rows.shape != (len(self.residual), 6 * count + lens):
            raise InputError(f"skyline: rows (Q, {6 * count + lens}) are needed, got {tuple(self.rows.shape)}")
        images = len(self.cameras)
        if not images or {len(self.names), len(self.columns), len(self.rms_px), len(self.sigmas)} != {images}:
            raise InputError("skyline: a camera, a name, columns and residuals for each image are needed")
        if any(not 0 <= camera < count for camera in self.cameras):
            raise InputError(f"skyline: cameras 0 to {count - 1} are there")
        require_finite("skyline: rows", self.rows)
        require_finite("skyline: residual", self.residual)
        require_finite("skyline: rotation", self.rotation[sorted(set(self.cameras))])


# Errors that many items of a source share: of a clock, of the air, of an antenna's place, of matching.


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Effect:
    """An error that many items of a source share and of which only the size is known: of a clock, the air, matching.

    Args:
        name: what it is, for messages.
        shift: what one sigma of it does to each item, as each camera sees it: (L, C, 3) meters by which landmarks are
            elsewhere, (F, C, 2) px by which marks of features are off, (S, C, 3) by which stars are seen elsewhere.
            Zero if left out.
        turn: (C, 3) radians about the frame's axes by which each camera sees the sky turned at one sigma; of stars
            only.
        factor: (S,) by which this turn is larger for some stars, as that of a clock that drifts; 1 if left out.

    Example:
        >>> velocity = torch.tensor([[5.0, 0.0, 0.0]], dtype=torch.float64)  # of one landmark, seen by two cameras
        >>> Effect(name="the clock, 0.1 s", shift=0.1 * velocity[:, None].expand(1, 2, 3)).shift[0, 0].tolist()
        [0.5, 0.0, 0.0]
    """

    name: str
    shift: Tensor | None = None
    turn: Tensor | None = None
    factor: Tensor | None = None


def shifts_of(effects: Sequence[Effect], shape: Sequence[int]) -> Tensor:
    """(E, *shape) the shifts of all effects, each of this shape."""
    zero = torch.zeros(*shape, dtype=torch.float64)
    return torch.stack([zero, *(zero if effect.shift is None else effect.shift for effect in effects)])[1:]


def star_turns(effects: Sequence[Effect], stars: int, cameras: int) -> Tensor:
    """(E, C, S, 3) radians by which each camera sees each star turned at one sigma of each effect."""
    found = torch.zeros(len(effects), cameras, stars, 3, dtype=torch.float64)
    for own, effect in zip(found, effects, strict=True):
        if effect.turn is not None:
            own += effect.turn[:, None] * (1.0 if effect.factor is None else effect.factor[:, None])
    return found


def _check_effects(kind: str, effects: Sequence[Effect], shape: tuple[int, ...], axes: str) -> None:
    for effect in effects:
        shift, turn, factor = effect.shift, effect.turn, effect.factor
        good = shift is None or (shift.shape == shape and bool(torch.isfinite(shift).all()))
        if not good or (kind != "stars" and (turn is not None or shift is None)):
            raise InputError(f"{kind}: the effect of {effect.name} needs finite shifts {axes}")
        fits = (turn is None or turn.shape == (shape[1], 3)) and (factor is None or factor.shape == shape[:1])
        if not fits:
            raise InputError(f"{kind}: the effect of {effect.name} has another shape than stars and cameras")


def _effects_of_both(one: Sequence[Effect], count: int, other: Sequence[Effect], more: int) -> tuple[Effect, ...]:
    """Effects of `count` items and of `more` others, for all of them: each shifts its own alone."""
    around = [(effect, 0, more) for effect in one] + [(effect, count, 0) for effect in other]
    return tuple(
        dataclasses.replace(effect, shift=torch.nn.functional.pad(effect.shift, (0, 0, 0, 0, before, after)))
        for effect, before, after in around
        if effect.shift is not None
    )


# Stars that several cameras of a rig saw at the same moments: at infinity, known to a few millionths of a radian.


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class StarSource:
    """Stars that cameras of a rig saw at the same moments, each with its own sigma.

    A star is at infinity: it tells how the cameras are turned against each other, yaw included, and where it has a
    name, how they stand on the Earth. It tells nothing of where they stand. `kcal.stars.star_source` makes it from
    images.

    Args:
        names: one for each star in each pair of images.
        pixels: (S, C, 2), NaN where a camera did not see it.
        pixel_sigma: (S, C) of a star along an axis, px.
        direction: (S, 3) unit vectors in the local frame, refracted; NaN for stars without a name.
        direction_sigma: (S,) radians, of the catalogue and of the model of refraction; infinite without a name.
        effects: what shifts all stars together: the clocks, the air.

    Raises:
        InputError: shapes that do not fit, or sigmas that are not positive.
    """

    names: tuple[str, ...]
    pixels: Tensor
    pixel_sigma: Tensor
    direction: Tensor
    direction_sigma: Tensor
    effects: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        count, shape = len(self.names), self.pixels.shape
        if self.pixels.ndim != 3 or shape[::2] != (count, 2) or self.pixel_sigma.shape != shape[:2]:
            raise InputError(f"stars: pixels ({count}, C, 2) and a sigma for each are needed")
        if self.direction.shape != (count, 3) or self.direction_sigma.shape != (count,):
            raise InputError(f"stars: directions ({count}, 3) and a sigma ({count},) are needed")
        if len(set(self.names)) != count:
            raise InputError("stars: a name is there twice")
        seen = torch.isfinite(self.pixels).all(-1)
        if not bool((self.pixel_sigma[seen] > 0).all() & torch.isfinite(self.pixel_sigma[seen]).all()):
            raise InputError("stars: every pixel_sigma must be a positive number")
        if not bool((self.direction_sigma > 0).all()):
            raise InputError("stars: every direction_sigma must be positive; it is infinite without a name")
        require_finite("stars: directions", self.direction[self.named])
        _check_effects("stars", self.effects, (count, shape[1], 3), "(S, C, 3)")

    @property
    def named(self) -> Tensor:
        """(S,) whether a star's direction is known."""
        return torch.isfinite(self.direction_sigma)


# Hold what a rig is solved from: boards, surveyed landmarks, far features, measured baselines and positions.
#
# All of it is in one local frame in meters: east, north, up of an origin where anything is known on the Earth
# (`kcal.locate.survey` reads latitudes and longitudes), the first camera's frame where nothing is. `C` is the number of
# cameras throughout; pixels are NaN where a camera did not see something.


def _positive(name: str, value: float) -> None:
    if not 0 < value < math.inf:
        raise InputError(f"{name}: a positive number is needed, got {value}")


def _check_marks(kind: str, names: tuple[str, ...], pixels: Tensor) -> None:
    """Refuse marks that are not one in each camera for each name."""
    count = len(names)
    if pixels.ndim != 3 or pixels.shape[::2] != (count, 2):
        raise InputError(f"{kind}: pixels ({count}, C, 2) are needed, got {tuple(pixels.shape)}")
    _names(kind, names, count)


def _names(kind: str, names: tuple[str, ...], count: int) -> None:
    if len(names) != count:
        raise InputError(f"{kind}: {len(names)} names for {count}; one each is needed")
    twice = sorted(name for name, times in Counter(names).items() if times > 1)
    if twice:
        raise InputError(f"{kind}: the name {twice[0]!r} is there twice")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Boards:
    """Boards shown to several cameras at the same moment.

    Args:
        board: the board.
        pixels: (V, C, N, 2) its corners.
        names: one for each moment.
        deviation: (N, 3) meters of each corner, as measured, from where it should be by the order; zero if left out.
        views: for each camera the names of its views, where that is known: those that its calibration used as well are
            taken out of what it knows, so that they do not count twice.
        covariance: (V, C, N, 2, 2) px² of corners, by which they weigh; all alike if left out.
        sigma: of a corner along an axis, px; estimated from the residuals if left out.
    """

    __repr__ = brief

    board: Board
    pixels: Tensor
    names: tuple[str, ...]
    deviation: Tensor | None = None
    views: tuple[tuple[str, ...], ...] | None = None
    covariance: Tensor | None = None
    sigma: float | None = None

    @property
    def points(self) -> Tensor:
        """(N, 3) meters: the board's corners as measured, or as ordered."""
        return self.board.points if self.deviation is None else self.board.points + self.deviation

    def __post_init__(self) -> None:
        if self.deviation is not None and self.deviation.shape != (self.board.corners, 3):
            raise InputError(
                f"boards: a deviation ({self.board.corners}, 3) is needed, got {tuple(self.deviation.shape)}"
            )
        if self.pixels.ndim != 4 or self.pixels.shape[2:] != (self.board.corners, 2):
            raise InputError(
                f"boards: pixels (V, C, {self.board.corners}, 2) are needed, got {tuple(self.pixels.shape)}"
            )
        _names("boards", self.names, len(self.pixels))
        if self.views is not None and [len(own) for own in self.views] != [len(self.pixels)] * self.pixels.shape[1]:
            raise InputError("boards: a name of each camera's view is needed for every moment")
        if self.covariance is not None and self.covariance.shape != (*self.pixels.shape, 2):
            raise InputError(
                f"boards: a covariance {(*self.pixels.shape, 2)} is needed, got {tuple(self.covariance.shape)}"
            )
        if self.sigma is not None:
            _positive("boards: sigma", self.sigma)

    def whitening(self, sigma: float) -> Tensor:
        """(V, C, N, 2, 2) by which residuals are multiplied; corners have `sigma` on average."""
        if self.covariance is None:
            return (torch.eye(2, dtype=torch.float64) / sigma).expand(*self.pixels.shape, 2)
        flat = self.covariance.flatten(0, 2)
        return (whitening(flat, sigma**2) / sigma).unflatten(0, self.pixels.shape[:3])


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Landmarks:
    """Surveyed points, marked in the images.

    Args:
        names: one for each.
        points: (L, 3) meters in the local frame.
        sigma: (L, 3) meters along the frame's axes, of the survey; independent from point to point.
        pixels: (L, C, 2) marks.
        pixel_sigma: of a mark along an axis, px; one number for all, or (L, C) for each mark.
        effects: what shifts many of them together, beyond `sigma`.
    """

    __repr__ = brief

    names: tuple[str, ...]
    points: Tensor
    sigma: Tensor
    pixels: Tensor
    pixel_sigma: float | Tensor = 0.3
    effects: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        count = len(self.names)
        if self.points.shape != (count, 3) or self.sigma.shape != (count, 3):
            raise InputError(
                f"landmarks: points and sigma ({count}, 3) are needed, got {tuple(self.points.shape)} and "
                f"{tuple(self.sigma.shape)}"
            )
        _check_marks("landmarks", self.names, self.pixels)
        require_finite("landmarks: points", as_points("landmarks: points", self.points, 3))
        if not bool((torch.isfinite(self.sigma) & (self.sigma > 0)).all()):
            raise InputError("landmarks: every sigma must be a positive number of meters; nothing is surveyed exactly")
        _check_effects("landmarks", self.effects, (*self.pixels.shape[:2], 3), "(L, C, 3)")
        if not isinstance(self.pixel_sigma, Tensor):
            _positive("landmarks: pixel_sigma", self.pixel_sigma)
            return
        if self.pixel_sigma.shape != self.pixels.shape[:2]:
            raise InputError(f"landmarks: pixel_sigma {tuple(self.pixels.shape[:2])} is needed, one for each mark")
        sigma = self.pixel_sigma[torch.isfinite(self.pixels).all(-1)]
        if not bool((torch.isfinite(sigma) & (sigma > 0)).all()):
            raise InputError("landmarks: pixel_sigma must be a positive number of pixels wherever there is a mark")

    def __add__(self, other: Landmarks) -> Landmarks:
        """Both, with a sigma for each mark; effects shift only those whose they are."""
        return Landmarks(
            names=self.names + other.names,
            points=torch.cat([self.points, other.points]),
            sigma=torch.cat([self.sigma, other.sigma]),
            pixels=torch.cat([self.pixels, other.pixels]),
            pixel_sigma=torch.cat([self._each(), other._each()]),
            effects=_effects_of_both(self.effects, len(self.names), other.effects, len(other.names)),
        )

    def _each(self) -> Tensor:
        return torch.as_tensor(self.pixel_sigma, dtype=torch.float64).expand(self.pixels.shape[:2])


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Features:
    """Things matched between the images whose position nobody surveyed.

    A feature alone determines the epipolar geometry: relative pitch and roll. It determines relative yaw if something
    is known of its range, and the farther away it is, the less need be known: a summit 20 km ± 2 km away is
    0.8 ± 0.08 px of disparity with 10 m of baseline and f 1600 px; a star has none.

    Args:
        names: one for each.
        pixels: (F, C, 2) marks.
        inverse_range: (F,) one over meters from the middle of the rig; 0 at infinity.
        inverse_range_sigma: (F,) its standard deviation; infinite where the range is not known.
        pixel_sigma: of a mark along an axis, px.
        covariance: (F, C, 2, 2) px² of marks, in place of `pixel_sigma`.
        effects: errors that marks of many of them share, beyond these.
    """

    __repr__ = brief

    names: tuple[str, ...]
    pixels: Tensor
    inverse_range: Tensor
    inverse_range_sigma: Tensor
    pixel_sigma: float = 0.3
    covariance: Tensor | None = None
    effects: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        count = len(self.names)
        _check_marks("features", self.names, self.pixels)
        if self.inverse_range.shape != (count,) or self.inverse_range_sigma.shape != (count,):
            raise InputError(f"features: inverse_range and its sigma ({count},) are needed")
        if not bool((torch.isfinite(self.inverse_range) & (self.inverse_range_sigma > 0)).all()):
            raise InputError("features: inverse ranges must be finite and their sigmas positive")
        _positive("features: pixel_sigma", self.pixel_sigma)
        if self.covariance is not None and self.covariance.shape != (*self.pixels.shape, 2):
            raise InputError(
                f"features: a covariance {(*self.pixels.shape, 2)} is needed, got {tuple(self.covariance.shape)}"
            )
        _check_effects("features", self.effects, self.pixels.shape, "(F, C, 2)")

    def __add__(self, other: Features) -> Features:
        """Both, with a covariance for each mark; effects shift only those whose they are."""
        both = self._whole(), other._whole()
        return Features(
            names=self.names + other.names,
            pixels=torch.cat([self.pixels, other.pixels]),
            inverse_range=torch.cat([self.inverse_range, other.inverse_range]),
            inverse_range_sigma=torch.cat([self.inverse_range_sigma, other.inverse_range_sigma]),
            covariance=torch.cat(both),
            effects=_effects_of_both(self.effects, len(self.names), other.effects, len(other.names)),
        )

    def _whole(self) -> Tensor:
        alike = self.pixel_sigma**2 * torch.eye(2, dtype=torch.float64).expand(*self.pixels.shape, 2)
        return alike if self.covariance is None else self.covariance


def inverse_range_beyond(meters: float) -> tuple[float, float]:
    """Inverse range and its standard deviation of what is known to be farther than `meters`.

    Any inverse range from 0 to 1 / meters is taken as equally likely: the mean and the spread of that.

    Example:
        >>> inverse_range_beyond(1000.0)[0]
        0.0005
    """
    _positive("range", meters)
    return 0.5 / meters, 1.0 / (meters * math.sqrt(12.0))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Baseline:
    """A measured distance between the centers of two cameras, meters."""

    first: int
    second: int
    length: float
    sigma: float

    def __post_init__(self) -> None:
        _positive("baseline", self.length)
        _positive("baseline: sigma", self.sigma)
        if self.first == self.second:
            raise InputError("baseline: two different cameras are needed")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredPosition:
    """A camera's projection center, measured (by GNSS, say): (3,) meters in the local frame and its (3,) sigmas."""

    camera: int
    point: Tensor
    sigma: Tensor

    def __post_init__(self) -> None:
        if self.point.shape != (3,) or self.sigma.shape != (3,) or not bool(torch.isfinite(self.point).all()):
            raise InputError("position: three meters and three sigmas are needed")
        if not bool((torch.isfinite(self.sigma) & (self.sigma > 0)).all()):
            raise InputError("position: every sigma must be a positive number of meters")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RigData:
    """All that a rig is solved from; any of it may be missing.

    Args:
        cameras: calibrated, two or more, or one with landmarks; unlike sizes and models are welcome.
        names: of the cameras.
        boards: see `Boards`.
        landmarks: see `Landmarks`.
        features: see `Features`.
        baselines: see `Baseline`.
        positions: see `MeasuredPosition`.
        stars: see `StarSource`.
        skyline: see `SkylineSource`.

    Raises:
        InputError: names or shapes that do not fit each other, one camera without landmarks or skyline.

    Example:
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080))
        >>> RigData(cameras=(camera, camera), names=("left", "right")).absolute
        False
    """

    __repr__ = brief

    cameras: tuple[Camera, ...]
    names: tuple[str, ...]
    boards: Boards | None = None
    landmarks: Landmarks | None = None
    features: Features | None = None
    baselines: tuple[Baseline, ...] = ()
    positions: tuple[MeasuredPosition, ...] = ()
    stars: StarSource | None = None
    skyline: SkylineSource | None = None

    def __post_init__(self) -> None:
        count = len(self.cameras)
        if not count or (count == 1 and self.landmarks is None and self.skyline is None):
            raise InputError("a rig has two cameras or more; one camera alone needs landmarks, or a skyline")
        _names("cameras", self.names, count)
        if not all(isinstance(camera, Camera) and camera.params.ndim == 1 for camera in self.cameras):
            raise InputError("a rig is made of single cameras")
        for kind, source in (
            ("boards", self.boards),
            ("landmarks", self.landmarks),
            ("features", self.features),
            ("stars", self.stars),
        ):
            if source is not None and source.pixels.shape[1] != count:
                raise InputError(f"{kind}: pixels of {source.pixels.shape[1]} cameras, the rig has {count}")
        if self.stars is not None and bool(self.stars.named.any()) and not self.absolute:
            raise InputError("stars with names need a frame on the Earth: landmarks, or a camera's measured position")
        if self.skyline is not None and len(self.skyline.rotation) != count:
            raise InputError(f"skyline: attitudes of {len(self.skyline.rotation)} cameras, the rig has {count}")
        if self.skyline is not None and not self.absolute:
            raise InputError("a skyline needs a frame on the Earth: landmarks, or a camera's measured position")
        numbers = [n for b in self.baselines for n in (b.first, b.second)] + [p.camera for p in self.positions]
        if any(not 0 <= number < count for number in numbers):
            raise InputError(f"baselines and positions name cameras 0 to {count - 1}")

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of what shifts stars, then landmarks, and then features, together."""
        return tuple(effect.name for source in with_effects(self) for effect in source.effects)

    @property
    def absolute(self) -> bool:
        """Whether anything places the rig in the local frame; otherwise that is the first camera's."""
        return self.landmarks is not None or bool(self.positions)


def with_effects(data: RigData) -> tuple[StarSource | Landmarks | Features, ...]:
    """The sources that may have effects, in the order in which `RigData.effects` names these."""
    return tuple(source for source in (data.stars, data.landmarks, data.features) if source is not None)
