"""What the field of a hybrid lens is made of: features with weights; Gaussian units of several widths are some."""

from __future__ import annotations

import copy
import dataclasses
import functools
import hashlib
import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

import torch
from torch import Tensor, nn
from torch.func import jvp

from kcal.errors import InputError
from kcal.texts import briefly

# What the field of a hybrid lens is made of: features with weights, whose prior widths the evidence of the views sets.
#
# Three kinds exist: `kcal.lens.zernike.ZernikeModes`, the default, `GaussianModes` and
# `kcal.lens.field_modes.NetworkModes`. All can be compared and hashed. They are constants of a fit, which finds the
# weights; only the inside of a network may be trained.


@briefly
class WeightPrior(NamedTuple):
    """The prior width of a weight, in radii of the disc: exp(h[amplitude] - exp(h[decay]) degree).

    Attributes:
        amplitude: index of a hyperparameter of the modes; None: pixels are square, and the width says how surely.
        decay: index of another one; None: there is none.
        degree: how fine the feature is.
    """

    amplitude: int | None
    decay: int | None
    degree: float


class FieldModes:
    """Features of a field on the unit disc, each a smooth displacement (f, g) of the place (x, y).

    Those of units have one weight along x and one along y for each unit, those along x first.

    Attributes:
        names: of the weights.
    """

    names: tuple[str, ...]

    def __len__(self) -> int:
        """Number of weights."""
        return len(self.names)

    @property
    def radial_names(self) -> frozenset[str]:
        """Names of those whose field is symmetric about the axis: no unit is."""
        return frozenset()

    @property
    def hyperprior(self) -> tuple[tuple[float, float, float], ...]:
        """Mean, standard deviation and largest value of the natural logarithm of each hyperparameter."""
        raise NotImplementedError

    @property
    def weight_priors(self) -> tuple[WeightPrior, ...]:
        """Of each weight."""
        raise NotImplementedError

    @property
    def peaks(self) -> tuple[float, ...]:
        """Largest displacement by each feature on the disc, to order of magnitude: one for units."""
        return (1.0,) * len(self)

    def columns(self, x: Tensor, y: Tensor) -> Tensor:
        """Evaluate each feature at places (x, y) (..., N) of the unit disc: (M, 2, ..., N)."""
        raise NotImplementedError

    def fill_columns(self, out: Tensor, x: Tensor, y: Tensor, scale: Tensor) -> None:
        """Write `columns` times a scale (..., 2, N) into memory (M, ..., 2, N); nothing is differentiated."""
        torch.mul(self.columns(x, y).movedim(1, -2), scale, out=out)

    def field(self, weights: Tensor, x: Tensor, y: Tensor, slopes: bool = True) -> tuple[Tensor, ...]:
        """Evaluate the weighted sum: the displacement (f, g), and if wanted its slopes f_x, f_y, g_x, g_y.

        Args:
            weights: (..., M), broadcast against the leading shape of the places.
            x: (..., N) places on the unit disc.
            y: (..., N).
            slopes: whether these are needed.

        Returns:
            Two or six tensors (..., N).
        """
        raise NotImplementedError


def vector_columns(values: Tensor) -> Tensor:
    """Columns (2 K, 2, ..., N) of K scalar units (K, ..., N) with weights along x, then with weights along y."""
    zero = torch.zeros_like(values)
    return torch.cat([torch.stack([values, zero], 1), torch.stack([zero, values], 1)])


# A field of Gaussian units of several widths: for structure that is local in the image.
#
#     f = Σ_k w_k e(x; x_k, l_k) e(y; y_k, l_k),   e(x; c, l) = exp(-(x - c)² / 2 l²),   likewise g, with other weights
#
# This is a network of radial basis functions (Broomhead and Lowe 1988). The units of one width stand on a square grid.
# Because a Gaussian of two variables is a product, a grid of n x n units costs 2 n exponentials per point and one
# matrix product.

# Distance between the units of a grid, in widths. Denser units are nearly redundant.
_SPACING = 0.8
# Units stand up to so many widths beyond the disc, where they still act inside.
_BEYOND = 0.5


class _Grid(NamedTuple):
    """Units of one width.

    Attributes:
        width: of each unit.
        places: (n,) of the columns, and likewise of the rows.
        number: of the unit at each point of the grid (n columns, n rows), flat; one past the last where there is none.
        points: (K,) the points that have a unit.
    """

    width: float
    places: Tensor
    number: Tensor
    points: Tensor


@dataclasses.dataclass(frozen=True, kw_only=True)
class GaussianModes(FieldModes):
    """Gaussian units on square grids over the unit disc (`FieldModes`).

    The weights along x come first, the widest units first, then those along y. Their prior has one amplitude, and one
    decay per octave of width.

    Args:
        widths: of the units, in radii of the disc, from wide to narrow.

    Attributes:
        names: "g0.3x" is the weight along x of the third unit of the first width.

    Raises:
        InputError: no width, or widths that do not decrease from at most 4 to at least 0.02.

    Example:
        >>> modes = GaussianModes(widths=(1.0, 0.5))
        >>> len(modes), modes.names[:2], modes.names[-1]
        (76, ('g0.0x', 'g0.1x'), 'g1.28y')
    """

    widths: tuple[float, ...] = (1.0, 0.5, 0.25)

    # Computed once: compilers cannot trace lazily computed attributes.
    names: tuple[str, ...] = dataclasses.field(init=False, repr=False, compare=False)
    _grids: tuple[_Grid, ...] = dataclasses.field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        widths = tuple(float(width) for width in self.widths)
        falling = all(a > b for a, b in itertools.pairwise(widths))
        if not widths or not falling or not all(0.02 <= width <= 4.0 for width in widths):
            raise InputError(f"Gaussian modes: widths must decrease, from at most 4 to at least 0.02, got {widths}")
        grids = []
        for width in widths:
            step, limit = _SPACING * width, 1.0 + _BEYOND * width
            half = math.floor(limit / step)
            places = step * torch.arange(-half, half + 1, dtype=torch.float64)
            inside = (torch.hypot(places[:, None], places) <= limit).flatten()
            number = torch.where(inside, inside.cumsum(0) - 1, inside.sum())
            grids.append(_Grid(width, places, number, inside.nonzero()[:, 0]))
        names = [f"g{i}.{k}" for i, grid in enumerate(grids) for k in range(len(grid.points))]
        object.__setattr__(self, "widths", widths)
        object.__setattr__(self, "_grids", tuple(grids))
        object.__setattr__(self, "names", tuple(name + axis for axis in "xy" for name in names))

    @property
    def hyperprior(self) -> tuple[tuple[float, float, float], ...]:
        """See `FieldModes`: amplitude, and decay per octave."""
        return (math.log(1e-3), 2.0, math.inf), (math.log(1.5), 0.7, math.inf)

    @property
    def weight_priors(self) -> tuple[WeightPrior, ...]:
        """See `FieldModes`."""
        octaves = [math.log2(self.widths[0] / grid.width) for grid in self._grids for _ in grid.points]
        return tuple(WeightPrior(0, 1, octave) for octave in 2 * octaves)

    def columns(self, x: Tensor, y: Tensor) -> Tensor:
        """See `FieldModes`."""
        out = []
        for grid in self._grids:
            (across, _), (down, _) = (_gaussians(z, grid) for z in (x, y))
            units = across[..., :, None, :] * down[..., None, :, :]
            out.append(units.flatten(-3, -2)[..., grid.points.to(x.device), :])
        return vector_columns(torch.cat(out, -2).movedim(-2, 0))

    def field(self, weights: Tensor, x: Tensor, y: Tensor, slopes: bool = True) -> tuple[Tensor, ...]:
        """See `FieldModes`."""
        both = weights.unflatten(-1, (2, -1))
        parts: list[list[Tensor]] = []
        counts = [len(grid.points) for grid in self._grids]
        for grid, own in zip(self._grids, both.split(counts, -1), strict=True):
            (across, across_slope), (down, down_slope) = (_gaussians(z, grid) for z in (x, y))
            n = len(grid.places)
            # (2, rows, columns), so that one product serves both components.
            filled = torch.cat([own, torch.zeros_like(own[..., :1])], -1)[..., grid.number.to(own.device)]
            matrix = filled.unflatten(-1, (n, n)).transpose(-1, -2).flatten(-3, -2)
            along = (matrix @ across).unflatten(-2, (2, n))
            part = [(along * down[..., None, :, :]).sum(-2)]
            if slopes:
                turned = (matrix @ across_slope).unflatten(-2, (2, n))
                part += [(turned * down[..., None, :, :]).sum(-2), (along * down_slope[..., None, :, :]).sum(-2)]
            parts.append(part)
        value, *rates = (torch.stack(terms).sum(0) for terms in zip(*parts, strict=True))
        if not slopes:
            return value.unbind(-2)
        (f_x, g_x), (f_y, g_y) = (rate.unbind(-2) for rate in rates)
        return (*value.unbind(-2), f_x, f_y, g_x, g_y)


def _gaussians(z: Tensor, grid: _Grid) -> tuple[Tensor, Tensor]:
    """e(z; c, l) of places (..., N) along one axis, (..., n, N), and the derivative by z."""
    # As a tensor: ONNX would write a plain number as float32.
    inverse = torch.tensor(1.0 / grid.width, dtype=z.dtype, device=z.device)
    t = (z[..., None, :] - grid.places.to(z)[:, None]) * inverse
    value = torch.exp(-0.5 * (t * t))
    return value, -t * value * inverse


# A field that is any torch network: place on the unit disc in, correction out (Eq. 11 and Fig. 8 of the paper).
#
#     f = Σ_k w_k φ_k(x, y),   g = Σ_k v_k φ_k(x, y)
#
# The features φ are what enters the last linear layer of the network. So the field is linear in the weights w and v of
# that layer, which get Gaussian priors whose widths the evidence sets, as the weights of every field do. The weights
# inside φ are those of a torch module: fixed random ones (Rahimi and Recht 2007), trained ones
# (`kcal.calibrate.hybrid.network_fit`), or those that a user's own loop trains.

# Random features: |(a, b)| from one to eight, uniform in its logarithm. At eight, tanh rises within a quarter radius.
_LOWEST, _OCTAVES = 1.0, 3.0

# Slopes of the layers without weights that are known, as they are by default: of what enters and what leaves.
SLOPES: dict[type[nn.Module], Callable[[Tensor, Tensor], Tensor]] = {
    nn.Tanh: lambda _, out: 1.0 - out * out,
    nn.Sigmoid: lambda _, out: out * (1.0 - out),
    nn.SiLU: lambda z, out: torch.sigmoid(z) * (1.0 + z - out),
    nn.Softplus: lambda z, _: torch.sigmoid(z),
    nn.GELU: lambda z, _: torch.special.ndtr(z) + z * torch.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi),
    nn.Identity: lambda z, _: torch.ones_like(z),
}


class NetworkModes(FieldModes):
    """The features of a network on the unit disc (`kcal.lens.field_modes.FieldModes`).

    The weights along x come first, then those along y. Their prior has one amplitude, and one decay per octave of the
    features' steepness: the root mean square of a feature's slope on the disc over that of the feature.

    Args:
        trunk: from places (N, 2) to features (N, K), each place for itself. It is converted to float64 and frozen.
        vector: its two outputs are one displacement, which a single weight multiplies ("gain").

    Attributes:
        names: "n3x" is the weight along x of feature 3.

    Raises:
        InputError: a module that does not map places to finite features, each place for itself, or whose features do
            not depend on the place.

    Example:
        >>> modes = NetworkModes.random(40, seed=1)
        >>> len(modes), modes.names[0], modes.names[-1]
        (80, 'n0x', 'n39y')
        >>> modes == NetworkModes.random(40, seed=1)
        True
    """

    def __init__(self, trunk: nn.Module, *, vector: bool = False) -> None:
        self.trunk, self.vector = trunk.double().eval().requires_grad_(False), vector
        values = _outputs(trunk, _disc_places())
        count = values.shape[-1]
        if vector and count != 2:
            raise InputError(f"network modes: a displacement has two numbers for each place, got {count}")
        with torch.no_grad():
            if not torch.allclose(copy.deepcopy(trunk).train()(_disc_places()), values):
                raise InputError("the network of a field must do the same in training: no drop-out, no batch norm")
        if not count or not bool((values.std(0) > 1e-9 * (1.0 + values.abs().amax(0))).all()):
            raise InputError("network modes: at least one feature is needed, and each must depend on the place")
        self.names = network_names(None if vector else count)

    @classmethod
    def hidden_layer(cls, rows: Sequence[Sequence[float]]) -> Self:
        """Features tanh(a x + b y + c) of rows (a, b, c)."""
        layer = nn.Linear(2, len(rows), dtype=torch.float64)
        with torch.no_grad():
            matrix = torch.tensor(rows, dtype=torch.float64).reshape(-1, 3)
            layer.weight.copy_(matrix[:, :2])
            layer.bias.copy_(matrix[:, 2])
        return cls(nn.Sequential(layer, nn.Tanh()))

    @classmethod
    def random(cls, count: int = 60, seed: int = 0) -> Self:
        """Draw features whose bends cross the disc in random directions."""
        draw = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        steep = _LOWEST * torch.exp2(_OCTAVES * draw[:, 0])
        angle = 2.0 * math.pi * draw[:, 1]
        rows = torch.stack([steep * torch.cos(angle), steep * torch.sin(angle), steep * (2.0 * draw[:, 2] - 1.0)], 1)
        return cls.hidden_layer(rows.tolist())

    @classmethod
    def of(cls, network: nn.Module) -> tuple[Self, Tensor]:
        """The features of a copy of a network from places (N, 2) to corrections (N, 2), and their weights (M,).

        Where its last operation is an `nn.Linear`, the features are what enters it, whatever comes before; its bias is
        left out, because it is a shift of the principal point. Any other network is one displacement times a gain.

        Raises:
            InputError: as for the class.
        """
        network = copy.deepcopy(network).double().eval()
        places, outputs = _disc_places(), dict[nn.Module, Tensor]()
        result = _outputs(network, places)
        if result.shape[-1] != 2:
            raise InputError(f"a field has a correction (N, 2) for places (N, 2), got {tuple(result.shape)}")
        layers = {module: name for name, module in network.named_modules() if isinstance(module, nn.Linear)}
        hooks = [
            module.register_forward_hook(lambda module, _, output: outputs.update({module: output}))
            for module in layers
        ]
        with torch.no_grad():
            network(places)
        for hook in hooks:
            hook.remove()
        last = next((layer for layer, output in outputs.items() if torch.equal(output, result)), None)
        if not isinstance(last, nn.Linear):
            return cls(network, vector=True), torch.ones(1, dtype=torch.float64)
        weight, name = last.weight.detach(), layers[last]
        if not name:
            return cls(nn.Identity()), weight.flatten()
        parent, _, own = name.rpartition(".")
        setattr(network.get_submodule(parent), own, nn.Identity())
        modes = cls(network)
        shift = 0.0 if last.bias is None else last.bias
        if not torch.allclose(modes.trunk(places) @ weight.T + shift, result):
            raise InputError("field: the last layer is used more than once; give it another layer at its end")
        return modes, weight.flatten()

    def __eq__(self, other: object) -> bool:
        """Whether the features are the same: modules of one class with equal weights."""
        if not isinstance(other, NetworkModes) or self.vector != other.vector or repr(self.trunk) != repr(other.trunk):
            return False
        mine, others = self.trunk.state_dict(), other.trunk.state_dict()
        return mine.keys() == others.keys() and all(torch.equal(mine[key], others[key]) for key in mine)

    def __hash__(self) -> int:
        """Of what training does not change."""
        return hash((self.names, repr(self.trunk)))

    def __repr__(self) -> str:
        """The digest changes with every weight."""
        return f"NetworkModes({self.trunk.__class__.__name__}, {len(self)} weights, {self.digest})"

    @property
    def digest(self) -> str:
        """Twelve hex digits of names, shapes and values of all weights inside."""
        found = hashlib.sha256()
        for name, value in self.trunk.state_dict().items():
            found.update(repr((name, tuple(value.shape), value.tolist())).encode())
        return found.hexdigest()[:12]

    @property
    def hyperprior(self) -> tuple[tuple[float, float, float], ...]:
        """See `FieldModes`: amplitude, and decay per octave."""
        amplitude = (math.log(1e-3), 2.0, math.inf)
        return (amplitude,) if self.vector else (amplitude, (math.log(1.0), 0.7, math.inf))

    @property
    def weight_priors(self) -> tuple[WeightPrior, ...]:
        """See `FieldModes`."""
        if self.vector:
            return (WeightPrior(0, None, 0.0),)
        with torch.no_grad():
            x, y = _disc_places().unbind(-1)
            value, *slopes = self._features(x, y)
        steep = torch.stack(slopes).square().sum(0).mean(-1) / value.square().mean(-1)
        octaves = (0.5 * torch.log2(steep / _LOWEST**2)).clamp(-1.0, 6.0).tolist()
        return tuple(WeightPrior(0, 1, octave) for octave in 2 * octaves)

    @property
    def peaks(self) -> tuple[float, ...]:
        """See `FieldModes`: a little more than on the grid."""
        with torch.no_grad():
            return tuple((1.1 * self.columns(*_disc_places().unbind(-1)).norm(dim=1).amax(-1)).tolist())

    def _features(self, x: Tensor, y: Tensor, slopes: bool = True) -> tuple[Tensor, ...]:
        """The features (..., K, N) at places (..., N), and their derivatives by x and by y."""
        places = torch.stack(torch.broadcast_tensors(x, y), -1)
        flat = places.reshape(-1, 2)

        def shaped(values: Tensor) -> Tensor:
            return values.reshape(*places.shape[:-1], -1).transpose(-1, -2)

        if not slopes:
            return (shaped(self.trunk(flat)),)
        along = [one.expand_as(flat) for one in flat.new_tensor([[1.0, 0.0], [0.0, 1.0]])]
        if known_chain(self.trunk) is None:
            pairs = [jvp(self.trunk, (flat,), (one,)) for one in along]
            return shaped(pairs[0][0]), shaped(pairs[0][1]), shaped(pairs[1][1])
        # By hand: compilers, exporters and an outer forward mode cannot follow another one.
        value, (by_x, by_y) = flat, along
        for layer in known_chain(self.trunk) or ():
            before, value = value, layer(value)
            if isinstance(layer, nn.Linear):
                by_x, by_y = by_x @ layer.weight.mT, by_y @ layer.weight.mT
            else:
                slope = SLOPES[type(layer)](before, value)
                by_x, by_y = slope * by_x, slope * by_y
        return shaped(value), shaped(by_x), shaped(by_y)

    def columns(self, x: Tensor, y: Tensor) -> Tensor:
        """See `FieldModes`."""
        features = self._features(x, y, slopes=False)[0].movedim(-2, 0)
        return features[None] if self.vector else vector_columns(features)

    def field(self, weights: Tensor, x: Tensor, y: Tensor, slopes: bool = True) -> tuple[Tensor, ...]:
        """See `FieldModes`."""
        # A gain multiplies both components.
        both = weights[..., None] * torch.eye(2).to(weights) if self.vector else weights.unflatten(-1, (2, -1))
        value, *rates = ((both @ part).unbind(-2) for part in self._features(x, y, slopes))
        if not slopes:
            return value
        by_x, by_y = rates
        return (*value, by_x[0], by_y[0], by_x[1], by_y[1])


def known_chain(trunk: nn.Module) -> Sequence[nn.Module] | None:
    """The layers of a network that is a chain of known ones; None for other networks."""
    layers = list(trunk) if type(trunk) is nn.Sequential else [trunk]
    known = (type(one) is nn.Linear or (type(one) in SLOPES and repr(one) == repr(type(one)())) for one in layers)
    return layers if all(known) else None


def network_names(features: int | None) -> tuple[str, ...]:
    """Names of the weights of so many features; None: of one displacement."""
    return ("gain",) if features is None else tuple(f"n{k}{axis}" for axis in "xy" for k in range(features))


@functools.cache
def _disc_places() -> Tensor:
    """(N, 2) places on the unit disc and on its rim."""
    line, angle = torch.linspace(-1, 1, 25).double(), torch.linspace(0, 2 * math.pi, 64).double()
    places = torch.cat([torch.cartesian_prod(line, line), torch.stack([angle.cos(), angle.sin()], -1)])
    return places[places.norm(dim=-1) <= 1.0 + 1e-9]


@torch.no_grad()
def _outputs(module: Callable[[Tensor], Tensor], places: Tensor) -> Tensor:
    """What a module makes of places (N, 2).

    Raises:
        InputError: not a value for each place, finite, float64, and the same whatever the other places are.
    """
    try:
        found, few = module(places), module(places[-3:])
    except Exception as error:
        raise InputError(f"the network of a field maps places (N, 2) to (N, K); it fails: {error}") from error
    if not isinstance(found, Tensor) or found.ndim != 2 or len(found) != len(places) or found.dtype != torch.float64:
        what = f"{tuple(found.shape)}, {found.dtype}" if isinstance(found, Tensor) else type(found).__name__
        raise InputError(f"the network of a field maps places (N, 2) to (N, K) in float64, got {what}")
    if not bool(torch.isfinite(found).all()) or not torch.allclose(found[-3:], few):
        raise InputError("the network of a field must be finite and treat each place alone; here others change it")
    return found
