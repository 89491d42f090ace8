"""Which parameters of a camera are free, fixed, tied or have priors, by name."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence

import torch
from torch import Tensor

from kcal.calibrate.problem.coefficient_prior import CoefficientPrior
from kcal.calibrate.problem.priors import GaussianPrior, Term
from kcal.errors import InputError
from kcal.lens.model import PRESETS, LensModel
from kcal.lens.projection import INTRINSICS, parameter_names


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

    def collapse(self, columns: Tensor, dim: int) -> Tensor:
        """Derivatives by each unknown, from those by each parameter along `dim`: tied ones are added."""
        parts = self.collapsed(columns, dim)
        return parts[0] if len(parts) == 1 else torch.cat(parts, dim)

    def collapsed(self, columns: Tensor, dim: int) -> tuple[Tensor, ...]:
        """As `collapse`, in parts that are not yet joined: a copy of hundreds of columns takes long."""
        if self._plain:
            return (columns,)
        if self.slots[:2] == (0, 0) and self.slots[1:] == tuple(range(len(self))):
            # One focal length, as a rule.
            return columns.narrow(dim, 0, 1) + columns.narrow(dim, 1, 1), columns.narrow(dim, 2, len(self) - 1)
        shape = list(columns.shape)
        shape[dim] = len(self)
        return (columns.new_zeros(shape).index_add_(dim, torch.tensor(self.slots, device=columns.device), columns),)

    def expand(self, step: Tensor) -> Tensor:
        """A step of the unknowns (..., len) as a step of each parameter."""
        return step if self._plain else step[..., list(self.slots)]

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

    @property
    def _plain(self) -> bool:
        """Whether each parameter is an unknown, in their order."""
        return self.slots == tuple(range(len(self.slots)))


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
        for name, (mean, sigma) in self.priors.items():
            if not (math.isfinite(mean) and math.isfinite(sigma) and sigma > 0):
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
