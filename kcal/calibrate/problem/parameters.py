"""Which parameters of a camera are free, fixed, tied or have priors, by name, and the residuals of the priors."""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping, Sequence

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.gaussian import Gaussian
from kcal.lens.model import PRESETS, LensModel
from kcal.lens.projection import INTRINSICS, parameter_names
from kcal.texts import brief

# Residuals of the shared parameters alone: Gaussian priors, and barriers before folds and poles of a lens.

# d ln r_D / d ln r is 1 for a pinhole, 0 where a lens folds, and large before a pole. Between these bounds there is no
# cost; a fisheye lens at 80 degrees off the axis still has 0.15.
_LOWEST_SLOPE, _HIGHEST_SLOPE = 0.1, 8.0
# A coefficient of r^2j above this to the power j, with r in units of the radius, bends the lens within a fifth of the
# radius, where few corners are.
_SHARPEST = 30.0
# Radii at which the slope is checked: denser than a pole and a zero that nearly cancel.
_KNOTS = 96


class Term(ABC):
    """Residuals of the camera's parameters and the board's amplitudes, in pixels like all others.

    Example:
        >>> class NearlySquare(Term):  # fx and fy differ by some 2 px; corners have 0.1 px of noise
        ...     def rows(self, values):
        ...         rows = values.new_zeros(*values.shape[:-1], values.shape[-1] + 1, 1)
        ...         rows[..., 0, 0], rows[..., 1, 0] = 0.1 / 2, -0.1 / 2
        ...         rows[..., -1, 0] = (values[..., 0] - values[..., 1]) * 0.1 / 2
        ...         return rows
        >>> round(float(NearlySquare().cost(torch.tensor([802.0, 800.0, 320.0, 240.0, 0.0]))), 6)  # ½ 0.1²
        0.005
    """

    @abstractmethod
    def rows(self, values: Tensor) -> Tensor:
        """Derivatives and residuals.

        Args:
            values: (..., 5 + P + B), the camera's parameters and the amplitudes of the board's modes.

        Returns:
            (..., 5 + P + B + 1, Q): derivatives of Q residuals by each value; last the residuals, NaN where the
            values are not a lens. Q may be 0 where there is no cost.
        """

    def cost(self, values: Tensor) -> Tensor:
        """(...) half the sum of squared residuals."""
        return 0.5 * self.rows(values)[..., -1, :].square().sum(-1)

    def add_to(self, total: Tensor, values: Tensor, slots: Tensor) -> None:
        """Add products of the rows to those of a problem.

        Args:
            total: (..., S + 1, S + 1) of derivatives by S unknowns, and residuals; changed in place.
            values: see `rows`.
            slots: (5 + P + B,) the number of each value's unknown; -1 where it is held.
        """
        rows, free = self.rows(values), (slots >= 0).nonzero()[:, 0]
        if rows.shape[-1]:
            by_unknown = rows.new_zeros(*total.shape[:-1], rows.shape[-1])
            by_unknown.index_add_(-2, slots[free], rows[..., free, :])
            by_unknown[..., -1, :] = rows[..., -1, :]
            total += by_unknown @ by_unknown.transpose(-1, -2)


@dataclasses.dataclass(frozen=True)
class GaussianPrior(Term):
    """A Gaussian prior on some values: residuals (value - mean) · weight.

    Args:
        index: which values, (Q,).
        mean: (Q,).
        weight: (Q,), or (B, Q) of a batch: noise of a corner (pixels) over the standard deviation of the prior.
    """

    index: Tensor
    mean: Tensor
    weight: Tensor

    def rows(self, values: Tensor) -> Tensor:
        """See `Term.rows`."""
        derivative = values.new_zeros((*self.weight.shape[:-1], values.shape[-1], len(self.index)))
        derivative[..., self.index, torch.arange(len(self.index), device=values.device)] = self.weight
        residual = self._residual(values)
        return torch.cat([derivative.expand(*values.shape[:-1], -1, -1), residual[..., None, :]], -2)

    def _residual(self, values: Tensor) -> Tensor:
        return (values[..., self.index] - self.mean) * self.weight

    def cost(self, values: Tensor) -> Tensor:
        """See `Term.cost`."""
        return 0.5 * self._residual(values).square().sum(-1)

    def add_to(self, total: Tensor, values: Tensor, slots: Tensor) -> None:
        """See `Term.add_to`; without the rows, of which there may be hundreds."""
        residual, place = self._residual(values), slots[self.index]
        free = (place >= 0).nonzero()[:, 0]
        place, weight = place[free], self.weight[..., free].expand(*total.shape[:-2], -1)
        gradient = weight * residual[..., free]
        total.diagonal(dim1=-2, dim2=-1).index_add_(-1, place, weight.square())
        total[..., -1].index_add_(-1, place, gradient)
        total[..., -1, :].index_add_(-1, place, gradient)
        total[..., -1, -1] += residual.square().sum(-1)


@dataclasses.dataclass(frozen=True)
class GaussianTerm(Term):
    """What other data say of some values, whose errors go together; of one problem, not of a batch.

    Args:
        index: which values, (Q,).
        known: a Gaussian of these, in that order.
        noise: of a corner, pixels.
    """

    index: Tensor
    known: Gaussian
    noise: float

    def rows(self, values: Tensor) -> Tensor:
        """See `Term.rows`."""
        own = self.noise * self.known.placed(self.known.slots, values[self.index]).rows
        out = values.new_zeros(len(values) + 1, len(own))
        out[self.index], out[-1] = own[:, :-1].T, own[:, -1]
        return out


class FoldBarrier(Term):
    """A smooth barrier before lenses whose radial term folds or meets a pole within a radius.

    With q = d ln r_D / d ln r the residuals are weight · ln(q₀ / q) below q₀, weight · ln(q / q₁) above q₁, and zero
    between. So lenses that are regular by a margin are not changed at all, and lenses beyond the barrier have no cost
    (NaN). The barrier is low and wide, because at a steep one a solver rejects half its steps and hardly converges.
    Further residuals limit coefficients so large that they shape the lens only next to its axis, where there are hardly
    any data: without them these diverge together with the focal length.

    Args:
        model: the lens model.
        radius: up to which the lens must be regular, on the plane of `kcal.lens.projection`.
        weight: pixels; a third of a corner's noise is enough.
    """

    def __init__(self, model: LensModel, radius: float, weight: float) -> None:
        offset = len(INTRINSICS)
        self._top = [offset + i for i in model.numerator_index]
        self._bottom = [offset + i for i in model.denominator_index]
        self._weight = weight
        s = (torch.linspace(0.0, 1.0, _KNOTS + 1, dtype=torch.float64)[1:] * radius) ** 2
        orders = torch.arange(1, 1 + max(model.numerator, model.denominator), dtype=torch.float64)[:, None]
        self._powers = s**orders
        self._sharpness = (radius**2 / _SHARPEST) ** orders[:, 0]
        # s d/ds of the same.
        self._slopes = orders * self._powers

    def rows(self, values: Tensor) -> Tensor:
        """See `Term.rows`."""
        count, over = len(self._top), len(self._bottom)
        top, bottom = self._powers[:count], self._powers[:over]
        top_slopes, bottom_slopes = self._slopes[:count], self._slopes[:over]
        a, b = values[..., self._top], values[..., self._bottom]
        n, d = 1.0 + a @ top, 1.0 + b @ bottom
        turn_n, turn_d = (a @ top_slopes) / n, (b @ bottom_slopes) / d
        q = 1.0 + 2.0 * (turn_n - turn_d)
        scale = torch.cat([self._sharpness[:count], self._sharpness[:over]])
        sharp = torch.cat([a, b], -1) * scale
        lens = (n > 0) & (d > 0) & (q > 0)
        if bool((lens & (q >= _LOWEST_SLOPE) & (q <= _HIGHEST_SLOPE)).all() & (sharp.abs() <= 1.0).all()):
            return values.new_zeros((*values.shape[:-1], values.shape[-1] + 1, 0))
        low = q < 1.0
        excess = torch.where(low, math.log(_LOWEST_SLOPE) - torch.log(q), torch.log(q) - math.log(_HIGHEST_SLOPE))
        barrier = torch.where(lens, self._weight * excess.clamp_min(0.0), torch.nan)
        rate = torch.where(excess > 0, 2.0 * self._weight / q, 0.0) * torch.where(low, -1.0, 1.0)
        radial = [*self._top, *self._bottom]
        out = values.new_zeros((*values.shape[:-1], values.shape[-1] + 1, _KNOTS + len(radial)))
        by_top = (rate / n)[..., None, :] * (top_slopes - turn_n[..., None, :] * top)
        by_bottom = -(rate / d)[..., None, :] * (bottom_slopes - turn_d[..., None, :] * bottom)
        out[..., radial, :_KNOTS] = torch.cat([by_top, by_bottom], -2)
        beyond = (sharp.abs() - 1.0).clamp_min(0.0)
        slope = self._weight * torch.where(beyond > 0, scale * torch.sign(sharp), 0.0)
        out[..., radial, list(range(_KNOTS, _KNOTS + len(radial)))] = slope
        out[..., -1, :_KNOTS] = barrier
        out[..., -1, _KNOTS:] = self._weight * beyond
        return out


# A weak Gaussian prior that keeps lens coefficients small unless the data ask for more.

# Radius from which on coefficients are of order one for any lens: 45 degrees off the axis.
_FARTHEST = 1.0
# Decentering, prism and tilt are errors of assembly: with a width of 0.3 and corners out to 36 degrees, 0.8 degrees.
_ASSEMBLY = 1.0 / 30.0


@dataclasses.dataclass(frozen=True)
class CoefficientPrior:
    """Each coefficient's standard deviation lets its term shift the outermost corner by a share of its radius.

    Args:
        width: that share for radial terms, numerator and denominator alike; a thirtieth of it for decentering, prism
            and tilt.
        reach: radius of the outermost corner on the plane of `kcal.lens.projection`.
    """

    width: float
    reach: float

    def term(self, model: LensModel, noise: float, without: Collection[str] = ()) -> GaussianPrior:
        """The prior with mean zero as residuals, in proportion to corners with `noise` pixels.

        Example:
            >>> model = LensModel.named("opencv4")  # k1 k2 p1 p2
            >>> sigma = 1.0 / CoefficientPrior(0.3, 0.5).term(model, noise=1.0).weight
            >>> [round(float(value), 6) for value in sigma]
            [1.2, 4.8, 0.02, 0.02]
        """
        r = min(self.reach, _FARTHEST)
        # Tangential and tilt terms grow with the square of the radius.
        shift = dict.fromkeys(range(model.size), r / _ASSEMBLY)
        for orders in (model.numerator_index, model.denominator_index):
            shift |= {i: r ** (2 * j + 2) for j, i in enumerate(orders)}
        for orders in model.prism_index if model.prism else ():
            shift |= {i: r ** (2 * j + 1) / _ASSEMBLY for j, i in enumerate(orders)}
        kept = [i for i in shift if model.names[i] not in without]
        weight = torch.tensor([noise * shift[i] / self.width for i in kept], dtype=torch.float64)
        index = torch.tensor(kept, dtype=torch.long) + len(INTRINSICS)
        return GaussianPrior(index, torch.zeros_like(weight), weight)


def is_overparameterized(model: LensModel) -> bool:
    """Whether a lens model has coefficients that are nearly redundant."""
    return model.denominator > 0 or model.prism > 0 or model.tilt


# Which parameters of a camera are free, fixed, tied or have priors, by name.


@dataclasses.dataclass(frozen=True)
class FreeParameters:
    """Free parameters of a camera, some of which may be tied.

    Args:
        indices: of the free parameters, ascending.
        slots: for each of them the number of its unknown; tied parameters share one.
    """

    indices: tuple[int, ...]
    slots: tuple[int, ...]

    @classmethod
    def of(cls, free: FreeParameters | Sequence[int]) -> FreeParameters:
        """From indices, each with an unknown of its own."""
        return free if isinstance(free, FreeParameters) else cls(tuple(free), tuple(range(len(free))))

    def __len__(self) -> int:
        """How many unknowns there are."""
        return max(self.slots) + 1 if self.slots else 0

    def __iter__(self) -> Iterator[int]:
        """The parameters' indices."""
        return iter(self.indices)

    @property
    def leading(self) -> tuple[int, ...]:
        """For each unknown the index of the first parameter that follows it."""
        return tuple(self.indices[self.slots.index(slot)] for slot in range(len(self)))

    def expand(self, step: Tensor) -> Tensor:
        """A step of the unknowns (..., len) as a step of each parameter."""
        return step if self.slots == tuple(range(len(self.slots))) else step[..., list(self.slots)]

    def by_parameter(self, covariance: Tensor, count: int) -> Tensor:
        """(count, count) of all parameters from that of the unknowns: tied ones alike, held ones zero."""
        out = covariance.new_zeros(count, count)
        slots, indices = torch.tensor(self.slots, dtype=torch.long), torch.tensor(self.indices, dtype=torch.long)
        out[indices[:, None], indices] = covariance[slots[:, None], slots]
        return out

    def labels(self, names: Sequence[str]) -> list[str]:
        """For each unknown the names of the parameters that it is, among all `names`."""
        pairs = list(zip(self.indices, self.slots, strict=True))
        return [" = ".join(names[index] for index, own in pairs if own == slot) for slot in range(len(self))]


@dataclasses.dataclass(frozen=True, kw_only=True)
class ParameterConstraints:
    """What the user knows about a camera's parameters; skew is held at 0 unless it is named.

    Args:
        fixed: name -> value.
        tied: groups of names that are equal.
        free: names that are estimated although they are held by default.
        priors: name -> (mean, standard deviation), both in the parameter's units.
        coefficient_prior: a prior on all coefficients without one of their own, or None.
    """

    __repr__ = brief

    fixed: Mapping[str, float] = dataclasses.field(default_factory=dict)
    tied: tuple[tuple[str, ...], ...] = ()
    free: tuple[str, ...] = ()
    priors: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    coefficient_prior: CoefficientPrior | None = None

    @property
    def has_priors(self) -> bool:
        """Whether there is any prior."""
        return bool(self.priors) or self.coefficient_prior is not None

    def check(self, model: LensModel) -> None:
        """Raise `InputError` for unknown names, contradictions, and values that are not finite or not positive."""
        tied = [name for group in self.tied for name in group]
        for name in (*self.fixed, *tied, *self.free, *self.priors):
            if name not in parameter_names(model):
                known = any(name in parameter_names(preset) for preset in PRESETS.values())
                raise InputError(
                    f"lens model {model} has no parameter {name!r}"
                    if known
                    else f"unknown parameter {name!r}" + f"; it has {', '.join(parameter_names(model))}"
                )
        held = {"skew"} - set(self.free)
        for name, value in self.fixed.items():
            if not math.isfinite(value) or (name in ("fx", "fy") and value <= 0):
                raise InputError(f"parameter {name} cannot be fixed at {value}")
            for other, names in (("tied", tied), ("freed", self.free), ("given a prior", self.priors)):
                if name in names:
                    raise InputError(f"parameter {name} is fixed and {other}: choose one of the two")
        for name in (*tied, *self.priors):
            if name in held:
                raise InputError(f"parameter {name} is held at 0: free it to tie it or to give it a prior")
        for group in self.tied:
            if len(group) < 2:
                raise InputError(f"a tie needs at least two parameters, got {', '.join(group) or 'none'}")
        twice = {name for name in tied if tied.count(name) > 1}
        if twice:
            raise InputError(f"parameter {min(twice)} is tied twice: write one tie with all parameters that are equal")
        for name, prior in self.priors.items():
            try:
                mean, sigma = prior
                sound = math.isfinite(mean) and math.isfinite(sigma) and sigma > 0
            except (TypeError, ValueError) as error:
                raise InputError(f"prior of {name} is {prior!r}; a pair (mean, sigma) is needed") from error
            if not sound:
                raise InputError(f"prior of {name} is {mean} ± {sigma}; it needs a positive standard deviation")

    def free_parameters(self, model: LensModel) -> FreeParameters:
        """The free parameters of a model."""
        names = parameter_names(model)
        held = ({"skew"} - set(self.free)) | set(self.fixed)
        leader = {name: group[0] for group in self.tied for name in group}
        indices = [i for i, name in enumerate(names) if name not in held]
        order: dict[str, int] = {}
        slots = [order.setdefault(leader.get(names[i], names[i]), len(order)) for i in indices]
        return FreeParameters(tuple(indices), tuple(slots))

    def impose(self, parameters: Tensor, model: LensModel) -> Tensor:
        """Parameters (..., 5 + P) that satisfy the constraints: fixed ones at their values, tied ones at their mean."""
        names, out = parameter_names(model), parameters.clone()
        for name, value in self.fixed.items():
            if name in names:
                out[..., names.index(name)] = value
        for group in self.tied:
            members = [names.index(name) for name in group if name in names]
            if members:
                out[..., members] = out[..., members].mean(-1, keepdim=True)
        return out

    def terms(self, model: LensModel, noise: float) -> tuple[Term, ...]:
        """The priors as residuals, in proportion to corners with `noise` pixels."""
        names = parameter_names(model)
        known = {name: prior for name, prior in self.priors.items() if name in names}
        found: list[Term] = []
        if known:
            mean, sigma = torch.tensor(list(known.values()), dtype=torch.float64).unbind(-1)
            found.append(GaussianPrior(torch.tensor([names.index(name) for name in known]), mean, noise / sigma))
        if self.coefficient_prior is not None:
            found.append(self.coefficient_prior.term(model, noise, {*self.fixed, *self.priors}))
        return tuple(found)


def natural_value(name: str, size: tuple[int, int]) -> float:
    """The value at which a parameter is fixed by name alone: the image's center, and 0 for skew and coefficients."""
    if name in INTRINSICS[:2]:
        raise InputError(f"parameter {name} has no natural value: give the value at which it is fixed")
    return {"cx": (size[0] - 1) / 2, "cy": (size[1] - 1) / 2}.get(name, 0.0)
