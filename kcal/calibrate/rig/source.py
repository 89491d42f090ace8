"""What a source tells the solver of a rig: rows of least squares by the items it saw, or by what was measured."""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import ClassVar, NamedTuple, Self

import torch
from torch import Tensor

from kcal.calibrate.rig.motion import BoardMotion, CameraRows
from kcal.calibrate.rig.unknowns import SharedUnknowns
from kcal.checks import chi2_quantile
from kcal.errors import InputError
from kcal.lens.calibration import ItemResidual
from kcal.lens.camera import Camera
from kcal.lens.pose import Pose, step_rows
from kcal.lens.projection import Projection, project_components
from kcal.texts import brief

# The state of a rig's adjustment.

# Unknowns of the largest item, the pose of a board, and numbers that describe it.
LOCAL_SIZE, OWN = 6, 12


class RigState(NamedTuple):
    """Everything that a rig's adjustment estimates, and the parameters that it holds.

    Attributes:
        parameters: of all cameras, one after the other.
        unknown: (K,) of cameras, board and air together; see `kcal.calibrate.rig.unknowns`.
        refraction: () coefficient of refraction.
        rotation: (C, 3, 3) cam_from_world.
        center: (C, 3) meters, in the world.
        board: (B,) amplitudes of the board's displacements.
        items: (V, 12) what is estimated of each item: of one source after the other, each as its `Block` says; zeros
            fill the rest.
    """

    parameters: Tensor
    unknown: Tensor
    refraction: Tensor
    rotation: Tensor
    center: Tensor
    board: Tensor
    items: Tensor


def as_items(*values: Tensor) -> Tensor:
    """(V, 12) of values (V, ...), one after the other."""
    flat = torch.cat([value.flatten(1) for value in values], 1)
    return torch.nn.functional.pad(flat, (0, OWN - flat.shape[1]))


class Start(NamedTuple):
    """Poses to begin with.

    Attributes:
        rotation: (C, 3, 3) cam_from_world.
        center: (C, 3) meters.
        boards: (V, 12) where boards are; see `kcal.calibrate.rig.sources.board_pose`.
    """

    rotation: Tensor
    center: Tensor
    boards: Tensor = torch.zeros(0, OWN, dtype=torch.float64)


def first_rays(cameras: Sequence[Camera], start: Start, pixels: Tensor, inverse: Tensor, anchor: Tensor) -> Tensor:
    """(V, 3) unit vectors along the ray of the first camera that sees each point; up where none does.

    Args:
        cameras: of the rig.
        start: their poses.
        pixels: (V, C, 2) of the points.
        inverse: (V,) inverse ranges from the anchor, 1/m.
        anchor: (3,) where the vectors begin.
    """
    direction = torch.zeros(len(pixels), 3, dtype=torch.float64)
    direction[:, 2] = 1.0
    for c in reversed(range(len(cameras))):
        rays, valid = cameras[c].unproject(pixels[:, c])
        towards = rays @ start.rotation[c] - inverse[:, None] * (anchor - start.center[c])
        direction = torch.where(valid[:, None], towards, direction)
    return direction / torch.linalg.vector_norm(direction, dim=-1, keepdim=True)


class PosedCamera(NamedTuple):
    """A camera as it stands during a solve, and where its unknowns are in a step (None: held).

    Attributes:
        by_unknown: (5 + P, K) its parameters by the K unknowns of cameras, board and air, the first of a step.
    """

    camera: Camera
    parameters: Tensor
    rotation: Tensor
    center: Tensor
    by_unknown: Tensor
    turn: slice | None
    shift: slice | None


# Errors that many items of a source share.


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

    __repr__ = brief

    name: str
    shift: Tensor | None = None
    turn: Tensor | None = None
    factor: Tensor | None = None


class Effects(NamedTuple):
    """What the E effects of a source do, and where their amounts are among the unknowns.

    Attributes:
        shifts: (E, V, C, 3) by which one sigma of each shifts the items, or (E, V, C, 2) px the marks.
        of_state: (E, K) of the unknowns in the state.
        of_step: (E, K) of those in a step; None where the step changes none of them.
    """

    shifts: Tensor
    of_state: Tensor
    of_step: Tensor | None

    def some(self, mask: Tensor) -> Effects:
        """The effects of the items in a mask alone."""
        return self._replace(shifts=self.shifts[:, mask])


# Checks of what a user gives.


def require_positive(name: str, value: float) -> None:
    """Refuse what is no positive number."""
    if not 0 < value < math.inf:
        raise InputError(f"{name}: a positive number is needed, got {value}")


def require_shape(name: str, value: Tensor | None, shape: tuple[int, ...]) -> None:
    """Refuse a tensor of another shape."""
    if value is not None and value.shape != shape:
        raise InputError(f"{name} {shape} is needed, got {tuple(value.shape)}")


def check_names(kind: str, names: tuple[str, ...], count: int) -> None:
    """Refuse names that are not one for each item, or that are there twice."""
    if len(names) != count:
        raise InputError(f"{kind}: {len(names)} names for {count}; one each is needed")
    twice = sorted(name for name, times in Counter(names).items() if times > 1)
    if twice:
        raise InputError(f"{kind}: the name {twice[0]!r} is there twice")


def typical_ratio(squares: Tensor, freedom: Tensor) -> float:
    """Median of χ² over what its median should be; 1 for fewer than four items."""
    known = (freedom > 0) & torch.isfinite(squares)
    if int(known.sum()) < 4:
        return 1.0
    return float((squares[known] / chi2_quantile(freedom[known], 0.5)).median())


# What a source is told of the adjustment, and of the fit of its items.


class Context(NamedTuple):
    """What a source needs to know of an adjustment to give its rows.

    Attributes:
        cameras: of the rig.
        state: as it is, with the items of the source alone.
        unknowns: those of the problem.
        anchor: (3,) from where features are counted, meters.
        times: by which the source's sigmas are multiplied.
        effects: of the source; None without any.
        sigma_corner: of a board's corner along an axis, px, as it counts.
        motion: how boards move while each camera reads its rows.
    """

    cameras: Sequence[Camera]
    state: RigState
    unknowns: SharedUnknowns
    anchor: Tensor
    times: float = 1.0
    effects: Effects | None = None
    sigma_corner: float = 1.0
    motion: Sequence[BoardMotion | None] = ()


class ItemFit(NamedTuple):
    """How well the V items of a source fit.

    Attributes:
        mask: which of them are asked.
        value: their χ², or by how much χ² would fall without each.
        square: their χ².
        freedom: their degrees of freedom beyond their own unknowns.
    """

    mask: Tensor
    value: Tensor
    square: Tensor
    freedom: Tensor


# The language of sources. A new source is a file with one class of these, and a line in `kcal.calibrate.rig.sources`.


class Source(ABC):
    """Something that a rig is solved from.

    Attributes:
        kind: its word in messages and records.
        absolute: whether it places the rig in the local frame.
    """

    kind: ClassVar[str]
    absolute: ClassVar[bool] = False

    @abstractmethod
    def check(self, cameras: int, *, absolute: bool) -> None:
        """Refuse what does not fit so many cameras, or needs a frame on the Earth that is not there."""

    def poses(self, cameras: Sequence[Camera], places: Mapping[int, Tensor]) -> dict[int, Pose]:
        """cam_from_world of cameras, by number, that this source alone tells; `places` are their measured centers."""
        return {}


class ItemSource(Source):
    """V items that were seen in the images of C cameras; each has unknowns of its own.

    Attributes:
        names: of the items.
        pixels: (V, C, 2), or (V, C, N, 2) of N marks each; NaN where not seen.
        effects: errors that many of them share.
        few: why an item cannot take part that has not `enough` marks.
        checks: what to check where the source as a whole is wrong.
        least: marks that a camera needs of an item.
        told_by: marks in all cameras below which residuals of an item tell nothing.
        own_noise: whether the noise of its marks is estimated, instead of being multiplied where it is stated too low.
        turns: whether the items tell how cameras are turned against each other, but nothing of where these stand.
        axes: of the shift by an effect: 3, or 2 where it shifts the marks.
    """

    names: tuple[str, ...]
    pixels: Tensor
    effects: tuple[Effect, ...] = ()
    few: ClassVar[str] = "fewer than two cameras have a mark of it"
    checks: ClassVar[str] = "check names, units, heights, sigmas and that the cameras are these"
    least: ClassVar[int] = 1
    told_by: ClassVar[int] = 1
    own_noise: ClassVar[bool] = False
    turns: ClassVar[bool] = False
    axes: ClassVar[int] = 3

    def check(self, cameras: int, *, absolute: bool) -> None:
        """See `Source.check`."""
        if self.pixels.shape[1] != cameras:
            raise InputError(f"{self.kind}: pixels of {self.pixels.shape[1]} cameras, the rig has {cameras}")

    def shifts(self) -> Tensor:
        """(E, V, C, 3) shifts of the items by its effects, or (E, V, C, 2) px of the marks."""
        zero = torch.zeros(*self.pixels.shape[:2], self.axes, dtype=torch.float64)
        return torch.stack([zero, *(zero if effect.shift is None else effect.shift for effect in self.effects)])[1:]

    @property
    def marked(self) -> Tensor:
        """(V, C) or (V, C, N) where there is a mark."""
        return torch.isfinite(self.pixels).all(-1)

    def enough(self, cameras: Sequence[Camera]) -> Tensor:
        """(V,) which items are seen well enough to take part."""
        return self.marked.sum(-1) >= 2

    @abstractmethod
    def begin(self, cameras: Sequence[Camera], start: Start) -> Tensor:
        """(V, 12) items to begin with."""

    @abstractmethod
    def block(self, mask: Tensor, given: Context) -> Block:
        """The rows of the items in the mask (V,)."""

    def over_limit(self, fit: ItemFit, level: float, given: Context, *, certain: bool) -> Tensor:
        """(V,) χ² of each item over the largest that noise explains; 0 outside the mask.

        Args:
            fit: of the items.
            level: probability that a good item stays below 1.
            given: the adjustment.
            certain: judge by the sigmas as they are, even if the source as a whole fits worse.
        """
        scale = 1.0 if certain else max(1.0, typical_ratio(fit.square, fit.freedom))
        return torch.where(fit.mask, fit.value / (scale * chi2_quantile(fit.freedom, level)), 0.0)

    @abstractmethod
    def doubt(self, off: str, sigmas: float, over: float) -> str:
        """Why an item was left out that is off by `off`, so many sigmas, and so many times over its limit."""

    def as_given(self, items: Tensor) -> Tensor:
        """(V, 12) where the items of the state are beforehand; items that were left out are compared with that."""
        return items

    def meters(self, items: Tensor) -> Tensor | None:
        """(V,) by which the items of the state are off where they were surveyed; None if they were not."""
        return None

    def places(self, items: Tensor, anchor: Tensor) -> Tensor | None:
        """(V, 3) meters in the local frame; None for what is at infinity."""
        return None


class MarkSource(ItemSource):
    """Items of which each camera that sees them has one mark.

    Attributes:
        pixel_sigma: of a mark along an axis, px; one number for all, or (V, C) for each mark.
        covariance: (V, C, 2, 2) px² of marks, in place of `pixel_sigma`.
    """

    pixel_sigma: float | Tensor
    covariance: Tensor | None = None

    def check_marks(self) -> None:
        """Refuse marks that are not one in each camera for each name, their sigmas, and effects of another shape."""
        shape, kind, sigma, count = self.pixels.shape, self.kind, self.pixel_sigma, len(self.names)
        if len(shape) != 3 or shape[::2] != (count, 2):
            raise InputError(f"{kind}: pixels ({count}, C, 2) are needed, got {tuple(shape)}")
        check_names(kind, self.names, count)
        if not isinstance(sigma, Tensor):
            require_positive(f"{kind}: pixel_sigma", sigma)
        elif sigma.shape != shape[:2]:
            raise InputError(f"{kind}: pixel_sigma {tuple(shape[:2])} is needed, one for each mark")
        elif not bool((torch.isfinite(sigma) & (sigma > 0))[self.marked].all()):
            raise InputError(f"{kind}: pixel_sigma must be a positive number of pixels wherever there is a mark")
        require_shape(f"{kind}: a covariance", self.covariance, (*shape, 2))
        for effect in self.effects:
            shift, turn, factor = effect.shift, effect.turn, effect.factor
            good = shift is None or (shift.shape == (*shape[:2], self.axes) and bool(torch.isfinite(shift).all()))
            if not good or (kind != "stars" and (turn is not None or shift is None)):
                axes = f"({kind[0].upper()}, C, {self.axes})"
                raise InputError(f"{kind}: the effect of {effect.name} needs finite shifts {axes}")
            if not ((turn is None or turn.shape == (shape[1], 3)) and (factor is None or factor.shape == shape[:1])):
                raise InputError(f"{kind}: the effect of {effect.name} has another shape than stars and cameras")

    @property
    def each_sigma(self) -> Tensor:
        """(V, C) px, `pixel_sigma` of each mark."""
        return torch.as_tensor(self.pixel_sigma, dtype=torch.float64).expand(self.pixels.shape[:2])

    def whitening(self, times: float) -> Tensor:
        """(V, C, 2, 2) by which residuals of pixels are multiplied, with sigmas so many times as large."""
        if self.covariance is None:
            return torch.eye(2, dtype=torch.float64) / (times * self.each_sigma[..., None, None])
        # Where a mark is missing, its covariance may be anything.
        return torch.linalg.inv(torch.linalg.cholesky_ex(self.covariance.nan_to_num(1.0))[0]) / times

    def by_mark(self) -> Self:
        """The same with the uncertainty of each mark, which two of a kind may be joined with."""
        return dataclasses.replace(self, pixel_sigma=self.each_sigma)  # type: ignore[type-var]

    def __add__(self, other: Self) -> Self:
        """Both; effects shift only those whose they are."""
        one, two = self.by_mark(), other.by_mark()
        around = [(effect, (0, len(two.names))) for effect in one.effects]
        around += [(effect, (len(one.names), 0)) for effect in two.effects]
        effects = tuple(
            dataclasses.replace(effect, shift=torch.nn.functional.pad(effect.shift, (0, 0, 0, 0, *more)))
            for effect, more in around
            if effect.shift is not None
        )
        parts = {name: torch.cat([own, getattr(two, name)]) for name, own in vars(one).items() if torch.is_tensor(own)}
        return dataclasses.replace(one, names=one.names + two.names, effects=effects, **parts)  # type: ignore[type-var]


class Measurement(Source):
    """Residuals of the cameras alone, in units of their standard deviations: what ties views of a rig."""

    def check(self, cameras: int, *, absolute: bool) -> None:
        """See `Source.check`."""
        if any(not 0 <= number < cameras for number in self.about):
            raise InputError(f"{self.kind} name cameras 0 to {cameras - 1}")

    @property
    @abstractmethod
    def about(self) -> tuple[int, ...]:
        """Numbers of the cameras that it is about."""

    @property
    @abstractmethod
    def count(self) -> int:
        """How many residuals there are."""

    @abstractmethod
    def rows_at(self, cameras: Sequence[PosedCamera], shared_size: int) -> Tensor:
        """(S + 1, Q): derivatives of Q residuals by the shared unknowns, and last these."""

    @abstractmethod
    def label(self, names: Sequence[str]) -> str:
        """What it is called in messages."""

    @abstractmethod
    def against(self, off: Tensor, sigma: Tensor) -> str:
        """What was stated, and what a solution without it says, in words.

        Args:
            off: (Q,) its residuals in that solution.
            sigma: (Q,) their standard deviations there; both in units of the stated ones.
        """

    @abstractmethod
    def told(self, center: Tensor, names: Sequence[str]) -> list[ItemResidual]:
        """Its records, once the centers (C, 3) of the cameras are solved."""

    def squares_px(self) -> tuple[Tensor, Tensor] | None:
        """(C,) squares of residuals in each image, px², and how many they are; None without any."""
        return None


# Rows of the items of one kind.


class Block(ABC):
    """V items of one kind, each with its own unknowns that no other item shares.

    States that its methods take contain its own items alone. Residuals are divided by their standard deviations: their
    squares add up to χ².

    Args:
        kind: of the source.
        pixels: (V, C, N, 2), NaN where not seen.

    Attributes:
        size: unknowns of each item, at most 6.
        by_rows: whether each item's own unknowns are eliminated from its rows by QR, because they may be hardly
            determined; otherwise by products.
        many: whether an item has many more rows than unknowns, as a board.
        surveyed: whether it is known where the items are, so that three of them place a camera.
    """

    size: int
    by_rows: ClassVar[bool] = False
    many: ClassVar[bool] = False
    surveyed: ClassVar[bool] = False

    def __init__(self, kind: str, pixels: Tensor) -> None:
        self.kind, self.pixels, self.seen = kind, pixels, torch.isfinite(pixels).all(-1)
        self._used = self.seen.any(-1).any(0).tolist()

    def __len__(self) -> int:
        """How many items there are."""
        return len(self.seen)

    @property
    def counts(self) -> Tensor:
        """(V,) residuals of each item."""
        return 2 * self.seen.sum((-2, -1))

    @property
    def freedom(self) -> Tensor:
        """(V,) degrees of freedom of each item beyond its own unknowns."""
        return self.counts - self.size

    @property
    def added(self) -> Tensor:
        """(C,) how many more residuals the items have with each camera than without it."""
        seen = self.seen.sum(-1)
        return (2 * seen * (seen.sum(1, keepdim=True) > seen)).sum(0)

    @abstractmethod
    def errors(self, cameras: Sequence[PosedCamera], state: RigState) -> Tensor:
        """(V, C, 2, N) projected minus seen, pixels; 0 where not seen."""

    @abstractmethod
    def residuals(self, cameras: Sequence[PosedCamera], state: RigState) -> Tensor:
        """(V, R) whitened residuals, pixels first."""

    @abstractmethod
    def camera_rows(self, cameras: Sequence[PosedCamera], state: RigState) -> Iterator[CameraRows]:
        """Rows of each camera that sees anything; last those of what is known of the items beforehand."""

    @abstractmethod
    def weighted(self, camera: int, columns: Tensor) -> Tensor:
        """(V, M, R) columns (V, M, 2, N) of a camera's pixels in the order and the units of its rows."""

    @abstractmethod
    def moved(self, items: Tensor, step: Tensor) -> Tensor:
        """Items (V, 12) after a step (V, L)."""

    def rows(self, cameras: Sequence[PosedCamera], state: RigState, shared_size: int) -> Tensor:
        """(V, L + S + 1, R) derivatives of whitened residuals by local and shared unknowns; last the residuals."""
        return self.joined(self.camera_rows(cameras, state), shared_size)

    def joined(self, parts: Iterable[CameraRows], shared_size: int) -> Tensor:
        """(V, L + S + 1, R) rows of all cameras and of what is known beforehand, with all columns."""
        out = []
        for _, columns, rows in parts:
            wide = rows.new_zeros(len(self), self.size + shared_size + 1, rows.shape[-1])
            wide[:, : self.size], wide[:, self.size + columns] = rows[:, : self.size], rows[:, self.size : -1]
            wide[:, -1] = rows[:, -1]
            out.append(wide)
        return torch.cat(out, -1)


# Rows of single marks.
#
# A camera with rotation R and center c sees the pixel of R q, q = y - w c. For points, w = 1 and y is the point. A
# feature in direction d at inverse range ρ from a place a near the rig has y = d + ρ a and w = ρ, so that q = d + ρ (a
# - c) is as regular at infinity as anywhere (Civera, Davison, Montiel 2008). In its units a meter is w, which entrance
# pupils that move depend on.


class MarkBlock(Block):
    """Items of which each camera that sees them has one mark.

    Args:
        source: of the items.
        mask: which of them.
        given: see there.
        priors: (V,) residuals of what is known of each item beforehand, or as many of each.
    """

    def __init__(self, source: MarkSource, mask: Tensor, given: Context, priors: Tensor | int) -> None:
        pixels = source.pixels[mask]
        super().__init__(source.kind, pixels[:, :, None])
        self._effects, self._priors = given.effects and given.effects.some(mask), priors
        self._target = torch.where(self.seen, pixels, 0.0)[..., None]
        self._whitening = torch.where(self.seen[..., None], source.whitening(given.times)[mask], 0.0)[..., None]

    @property
    def counts(self) -> Tensor:
        """See `Block.counts`."""
        return super().counts + self._priors

    @abstractmethod
    def _place(self, state: RigState) -> tuple[Tensor, Tensor]:
        """Where the items are: y (V, 3, N) and w (V, 1, 1)."""

    @abstractmethod
    def _by_own(self, state: RigState, by_q: Tensor, center: Tensor, by_w: Tensor | None) -> Tensor:
        """Derivatives (V, L, 2, N) of pixels by each item's unknowns, from those by q (V, 3, 2, N) and by w."""

    def _by_shared(self, state: RigState, by_q: Tensor, offset: Tensor) -> tuple[Tensor, Tensor] | None:
        """How pixels depend on what all items share, a board's shape or the air; None if they do not.

        Args:
            state: where.
            by_q: (V, 3, 2, N) derivatives of pixels by q in the world.
            offset: (V, 3, N) of the items from the camera.

        Returns:
            derivatives (V, E, 2, N) by E quantities, and these by the unknowns, (E, K).
        """
        return None

    def _shift(self, effects: Effects, state: RigState, camera: int) -> Tensor:
        """(E, V, 3) by which one sigma of each effect shifts the items for a camera, or (E, V, 2) px their marks."""
        return effects.shifts[:, :, camera]

    def _bent(self, state: RigState, offset: Tensor) -> Tensor:
        """Where points are seen (V, 3, N) that stand at `offset` from the camera."""
        return offset

    def _by_offset(self, state: RigState, by_q: Tensor, offset: Tensor) -> Tensor:
        """Derivatives by where points stand, from those by where they are seen."""
        return by_q

    def weighted(self, camera: int, columns: Tensor) -> Tensor:
        """See `Block.weighted`."""
        return torch.einsum("vuwn,vpwn->vpun", self._whitening[:, camera], columns).flatten(-2)

    def _prior(self, state: RigState) -> Tensor | None:
        """(V, L + 1, Q): derivatives of Q residuals of what is known of each item; the last row holds the residuals."""
        return None

    def _projected(
        self, cameras: Sequence[PosedCamera], state: RigState, derivatives: bool
    ) -> Iterator[tuple[int, PosedCamera, Tensor, Tensor, Tensor, Projection, Tensor]]:
        y, w = self._place(state)
        for c, posed in enumerate(cameras):
            if not self._used[c]:
                continue
            offset = y - w * posed.center[:, None]
            beside = offset.new_zeros(())
            if self._effects is not None:
                shift = torch.einsum(
                    "e,evk->vk", self._effects.of_state @ state.unknown, self._shift(self._effects, state, c)
                )
                if shift.shape[1] == 2:
                    beside = shift[..., None]
                else:
                    offset = offset + shift[..., None]
            q = posed.rotation @ self._bent(state, offset)
            wanted = posed.by_unknown.any(1).nonzero()[:, 0].tolist() if derivatives else None
            found = project_components(q, posed.parameters, posed.camera.model, wanted, w[..., 0])
            # NaN where a seen point has no projection, so that such a pose is never accepted.
            bad = torch.where(found.regular, 0.0, torch.nan)[..., None, :]
            error = torch.where(self.seen[:, c, None, :], found.pixels + beside - self._target[:, c] + bad, 0.0)
            yield c, posed, offset, q, w, found, error

    def errors(self, cameras: Sequence[PosedCamera], state: RigState) -> Tensor:
        """See `Block.errors`."""
        found = torch.zeros_like(self._target).unbind(1)
        used = {c: error for c, *_, error in self._projected(cameras, state, False)}
        return torch.stack([used.get(c, none) for c, none in enumerate(found)], 1)

    def residuals(self, cameras: Sequence[PosedCamera], state: RigState) -> Tensor:
        """See `Block.residuals`."""
        errors = self.errors(cameras, state).unbind(1)
        white = torch.cat([self.weighted(c, error[:, None])[:, 0] for c, error in enumerate(errors)], -1)
        prior = self._prior(state)
        return white if prior is None else torch.cat([white, prior[:, -1]], -1)

    def camera_rows(self, cameras: Sequence[PosedCamera], state: RigState) -> Iterator[CameraRows]:
        """See `Block.camera_rows`."""
        for c, posed, offset, q, w, found, error in self._projected(cameras, state, True):
            by_q = torch.einsum("vkun,kj->vjun", found.by_point, posed.rotation)
            by_offset = self._by_offset(state, by_q, offset)
            parts = [self._by_own(state, by_offset, posed.center, found.by_meter)]
            # Derivatives by what the shared unknowns change, and that by these unknowns.
            changed = list[tuple[Tensor, Tensor]]()
            used = posed.by_unknown.any(1)
            if bool(used.any()):
                changed.append((found.by_camera, posed.by_unknown[used]))
            if (shared := self._by_shared(state, by_q, offset)) is not None:
                changed.append(shared)
            if self._effects is not None and self._effects.of_step is not None:
                shift = self._shift(self._effects, state, c)
                marks = shift[..., None] if shift.shape[2] == 2 else torch.einsum("vjun,evj->evun", by_offset, shift)
                changed.append((marks.movedim(0, 1), self._effects.of_step))
            columns = torch.zeros(0, dtype=torch.long)
            if changed:
                by, onto = torch.cat([rows for rows, _ in changed], 1), torch.cat([maps for _, maps in changed])
                columns = onto.any(0).nonzero()[:, 0]
                parts.append((onto[:, columns].T @ by.flatten(2)).unflatten(2, by.shape[2:]))
            for slot in (posed.turn, posed.shift):
                if slot is not None:
                    columns = torch.cat([columns, torch.arange(slot.start, slot.stop)])
            if posed.turn is not None:
                parts.append(step_rows(found.by_point, q)[:, :3])
            if posed.shift is not None:
                parts.append(-w[..., None] * by_offset)
            rows = torch.cat([*parts, error[:, None]], 1)
            rows = torch.where(self.seen[:, c, None, None, :], rows, 0.0)
            yield CameraRows(c, columns, self.weighted(c, rows))
        prior = self._prior(state)
        if prior is not None:
            yield CameraRows(None, torch.zeros(0, dtype=torch.long), prior)
