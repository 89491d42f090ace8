"""Blocks inside kcal's files."""

from __future__ import annotations

import base64
import binascii
import math
import re
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import pydantic
import safetensors.torch
import torch
from torch import Tensor, nn

from kcal.checks import as_covariance
from kcal.errors import InputError
from kcal.lens.field_modes import SLOPES, FieldModes, GaussianModes, NetworkModes, known_chain, network_names
from kcal.lens.information import CameraInformation
from kcal.lens.model import LEADING, PORT, HybridForm, LensModel
from kcal.lens.zernike import ZernikeModes
from kcal.native_file import Record


class Packed(Record):
    """Many numbers in little space: `float64` is the base64 text of little-endian doubles, row by row.

    Args:
        shape: of the array.
        float64: its bytes.
    """

    shape: tuple[pydantic.NonNegativeInt, ...]
    float64: str

    @pydantic.model_validator(mode="after")
    def _filled(self) -> Packed:
        values = self._values()
        if len(values) != math.prod(self.shape):
            raise ValueError(f"{len(values)} numbers do not fill the shape {list(self.shape)}")
        if not np.isfinite(values).all():
            raise ValueError("packed numbers must be finite")
        return self

    def _values(self) -> np.ndarray:
        try:
            data = base64.b64decode(self.float64, validate=True)
        except binascii.Error as error:
            raise ValueError(f"float64 is not base64 text: {error}") from None
        if len(data) % 8:
            raise ValueError(f"float64 has {len(data)} bytes, which are no whole doubles")
        return np.frombuffer(data, dtype="<f8")

    @classmethod
    def of(cls, tensor: torch.Tensor) -> Packed:
        """A tensor, as it is stored."""
        values = tensor.detach().cpu().to(torch.float64).contiguous().numpy().astype("<f8")
        return cls(shape=tuple(tensor.shape), float64=base64.b64encode(values.tobytes()).decode("ascii"))

    def tensor(self) -> torch.Tensor:
        """The tensor, equal to the stored one to the last bit."""
        return torch.from_numpy(self._values().astype(np.float64)).reshape(self.shape)


class CovarianceRecord(Record):
    """The joint covariance of a camera's parameters.

    Args:
        names: of the parameters that were estimated, in the order of the camera's; all others are exact.
        matrix: their covariance, row by row: symmetric, in products of the parameters' units (pixels for intrinsics,
            none for coefficients, radians for tilts). A parameter that the data leave open has a very large variance.
    """

    names: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]

    @pydantic.model_validator(mode="after")
    def _is_covariance(self) -> CovarianceRecord:
        count = len(self.names)
        if len(set(self.names)) != count:
            raise ValueError("covariance: a name occurs twice")
        if len(self.matrix) != count or any(len(row) != count for row in self.matrix):
            raise ValueError(f"covariance: {count} names need {count} rows of {count} numbers")
        as_covariance("covariance", torch.tensor(self.matrix, dtype=torch.float64).reshape(count, count), count)
        return self

    @classmethod
    def of(cls, covariance: torch.Tensor, names: tuple[str, ...]) -> CovarianceRecord:
        """From a matrix of all parameters; those whose variance is zero are left out."""
        free = (covariance.diagonal() != 0).nonzero()[:, 0]
        rows = covariance[free[:, None], free].tolist()
        return cls(names=tuple(names[i] for i in free.tolist()), matrix=tuple(map(tuple, rows)))

    def expand(self, names: tuple[str, ...]) -> torch.Tensor:
        """The covariance (P, P) of all parameters `names`, zero for those that are exact."""
        places = torch.tensor([names.index(name) for name in self.names], dtype=torch.long)
        out = torch.zeros(len(names), len(names), dtype=torch.float64)
        if len(places):
            out[places[:, None], places] = torch.tensor(self.matrix, dtype=torch.float64)
        return out


# What a calibration says of a camera, as a block inside kcal's files.


class InformationRecord(Record):
    """A `CameraInformation` by the names of the parameters; parameters without a name are held.

    The unknowns are groups of parameters that are equal, then the amplitudes of the board's modes. The likelihood of
    the data near the estimate is exp(-½ ‖R (x - estimate) + r‖²), the prior exp(-½ Σ ((x - mean) / sigma)²).

    Args:
        unknowns: for each of the camera's unknowns the names of the parameters that it is.
        board: amplitudes of the board's modes at the estimate, meters.
        triangle: upper triangle of R, row by row, each row followed by its element of r.
        mean: of the prior.
        sigma: of the prior; None where nothing was assumed.
        others: what other cameras say of the board's unknowns, as `triangle`; None: nothing.
    """

    unknowns: tuple[tuple[str, ...], ...]
    board: tuple[float, ...]
    triangle: Packed
    mean: tuple[float, ...]
    sigma: tuple[pydantic.PositiveFloat | None, ...]
    others: Packed | None = None

    @pydantic.model_validator(mode="after")
    def _fits(self) -> InformationRecord:
        count = len(self.unknowns) + len(self.board)
        names = [name for group in self.unknowns for name in group]
        if len(set(names)) != len(names) or not all(self.unknowns):
            raise ValueError("information: a name occurs twice, or an unknown has none")
        if (len(self.mean), len(self.sigma), self.triangle.shape) != (count, count, (count * (count + 3) // 2,)):
            raise ValueError(f"information: mean, sigma and triangle must be those of {count} unknowns")
        if self.others is not None and self.others.shape != (len(self.board) * (len(self.board) + 3) // 2,):
            raise ValueError(f"information: others must be about the {len(self.board)} unknowns of the board")
        return self

    @classmethod
    def of(cls, known: CameraInformation, names: tuple[str, ...]) -> InformationRecord:
        """Convert for storage; `names` are those of the camera's parameters."""
        groups: list[list[str]] = [[] for _ in range(known.lens_size)]
        for name, slot in zip(names, known.slots, strict=True):
            if slot >= 0:
                groups[slot].append(name)
        others = None if known.others is None else Packed.of(_above(known.told.compressed().rows))
        return cls(
            unknowns=tuple(map(tuple, groups)),
            board=tuple(known.estimate[known.lens_size :].tolist()),
            triangle=Packed.of(_above(known.data.compressed().rows)),
            mean=tuple(known.mean.tolist()),
            sigma=tuple(value if math.isfinite(value) else None for value in known.sigma.tolist()),
            others=others,
        )

    def information(self, values: dict[str, float]) -> CameraInformation:
        """The `CameraInformation` of a camera with these values of its parameters, by name, in their order."""
        slots = {name: slot for slot, group in enumerate(self.unknowns) for name in group}
        lens, count = [values[group[0]] for group in self.unknowns], len(self.mean)
        rows = _triangle_of(self.triangle.tensor(), count)
        return CameraInformation(
            slots=tuple(slots.get(name, -1) for name in values),
            estimate=torch.tensor([*lens, *self.board], dtype=torch.float64),
            rows=rows[:, :-1],
            residuals=rows[:, -1],
            mean=torch.tensor(self.mean, dtype=torch.float64),
            sigma=torch.tensor([math.inf if value is None else value for value in self.sigma], dtype=torch.float64),
            others=None if self.others is None else _triangle_of(self.others.tensor(), len(self.board)),
        )


def _above(rows: torch.Tensor) -> torch.Tensor:
    """Elements of rows (C, C + 1) from the diagonal on."""
    row, column = torch.triu_indices(*rows.shape)
    return rows[row, column]


def _triangle_of(elements: torch.Tensor, count: int) -> torch.Tensor:
    """(C, C + 1) rows with these elements."""
    rows = torch.zeros(count, count + 1, dtype=torch.float64)
    row, column = torch.triu_indices(count, count + 1)
    rows[row, column] = elements
    return rows


# The lens model inside kcal's camera files.


class ZernikeRecord(Record):
    """The modes of a hybrid lens by their highest degrees (`kcal.lens.zernike.ZernikeModes`)."""

    radial: int
    decentered: int
    astigmatic: int
    other: int


class GaussianRecord(Record):
    """Gaussian units by their widths (`kcal.lens.field_modes.GaussianModes`)."""

    widths: tuple[float, ...]


# Layers without weights that a file describes.
_LAYERS = {layer.__name__.lower(): layer for layer in SLOPES}


class NetworkRecord(Record):
    """The network of a field, without its last layer (`kcal.lens.field_modes.NetworkModes`).

    Args:
        hidden: a, b, c of each feature tanh(a x + b y + c), in files of kcal 1.0; nothing else is said then.
        layers: of a chain: "linear 2 40", "tanh" and so on; None: the class of the network is not kcal's.
        kind: the name of its class, for messages.
        features: how many there are; None: the network makes one displacement.
        weights: the base64 text of its weights in the format safetensors.
        digest: `NetworkModes.digest`.
    """

    _LATER: ClassVar[Mapping[str, Any]] = {"hidden": None}

    hidden: tuple[tuple[float, float, float], ...] | None = None
    layers: tuple[str, ...] | None = None
    kind: str = ""
    features: pydantic.PositiveInt | None = None
    weights: str = ""
    digest: str = ""

    @classmethod
    def of(cls, modes: NetworkModes) -> NetworkRecord:
        """As it is stored."""
        state = {name: value.detach().cpu().contiguous() for name, value in modes.trunk.state_dict().items()}
        return cls(
            layers=_chain_texts(modes.trunk),
            kind=modes.trunk.__class__.__name__,
            features=None if modes.vector else len(modes) // 2,
            weights=base64.b64encode(safetensors.torch.save(state)).decode("ascii"),
            digest=modes.digest,
        )

    @property
    def known(self) -> bool:
        """Whether the file itself says what the network is."""
        return self.hidden is not None or self.layers is not None

    def modes(self, field: nn.Module | None) -> NetworkModes:
        """The network with its weights; `field` has the class that the file does not describe."""
        if self.hidden is not None:
            return NetworkModes.hidden_layer(self.hidden)
        if field is not None:
            found, _ = NetworkModes.of(field)
        elif self.layers is not None:
            found = NetworkModes(_built(self.layers), vector=self.features is None)
        else:
            raise InputError(
                f"the field of this camera is a network of the class {self.kind}, which is not kcal's and no command "
                f"can load: in Python, give such a module, as in load_camera(path, field={self.kind}())"
            )
        stored, own = self._state(), found.trunk.state_dict()
        shapes = [{name: tuple(value.shape) for name, value in each.items()} for each in (stored, own)]
        if shapes[0] != shapes[1] or found.names != network_names(self.features):
            name = next((n for n in {**shapes[0], **shapes[1]} if shapes[0].get(n) != shapes[1].get(n)), "features")
            raise InputError(
                f"the network that was given is not that of the file, a {self.kind}: {name} has the shape "
                f"{shapes[1].get(name)}, and {shapes[0].get(name)} there"
            )
        found.trunk.load_state_dict(stored)
        if found.digest != self.digest:
            raise InputError(f"network: its weights have the digest {found.digest}, and the file says {self.digest}")
        return NetworkModes(found.trunk, vector=found.vector)

    def _state(self) -> dict[str, Tensor]:
        try:
            return safetensors.torch.load(base64.b64decode(self.weights, validate=True))
        except (binascii.Error, safetensors.SafetensorError, KeyError) as error:
            raise InputError(f"network: its weights cannot be read: {error}") from None


def _chain_texts(trunk: nn.Module) -> tuple[str, ...] | None:
    """The layers of a chain that a file can describe; None for other modules."""
    chain = known_chain(trunk)
    if chain is None or type(trunk) is not nn.Sequential:
        return None
    return tuple(
        f"linear {layer.in_features} {layer.out_features}{'' if layer.bias is not None else ' unbiased'}"
        if isinstance(layer, nn.Linear)
        else layer.__class__.__name__.lower()
        for layer in chain
    )


def _built(layers: tuple[str, ...]) -> nn.Module:
    """The chain that a file describes, with any weights."""
    chain: list[nn.Module] = []
    for text in layers:
        linear = re.fullmatch(r"linear ([1-9]\d{0,3}) ([1-9]\d{0,3})( unbiased)?", text)
        if linear:
            chain.append(nn.Linear(int(linear[1]), int(linear[2]), bias=linear[3] is None))
        elif text in _LAYERS:
            chain.append(_LAYERS[text]())
        else:
            raise InputError(f"network: unknown layer {text!r}; a chain has linear IN OUT, {', '.join(_LAYERS)}")
    return nn.Sequential(*chain)


# The key under which a file has each kind of field.
_KINDS: dict[str, type] = {"modes": ZernikeModes, "gaussian": GaussianModes, "network": NetworkModes}


class HybridRecord(Record):
    """The constants of a hybrid lens (`kcal.lens.model.HybridForm`).

    Args:
        shape: of the base projection.
        radius: of the disc of the field, on the plane of the base projection.
        modes: of the field, if they are Zernike modes; exactly one of this and the following is in a file.
        gaussian: of the field, if it is made of Gaussian units.
        network: of the field, if it is the last layer of a network.
        port: whether rays start on the normal of a flat port; absent from the file where they do not.
    """

    _LATER: ClassVar[Mapping[str, Any]] = dict.fromkeys(_KINDS) | {"port": False}

    shape: float
    radius: float
    modes: ZernikeRecord | None = None
    gaussian: GaussianRecord | None = None
    network: NetworkRecord | None = None
    port: bool = False

    @classmethod
    def of(cls, form: HybridForm) -> HybridRecord:
        """The constants of a lens."""
        modes, own = form.modes, next(key for key, kind in _KINDS.items() if isinstance(form.modes, kind))
        stored = NetworkRecord.of(modes) if isinstance(modes, NetworkModes) else modes
        constants = {"shape": form.shape, "radius": form.radius, "port": form.port, own: stored}
        return cls.model_validate(constants, from_attributes=True)

    @pydantic.model_validator(mode="after")
    def _one_kind(self) -> HybridRecord:
        given = [key for key in _KINDS if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError(f"a field has one kind, {' or '.join(_KINDS)}; got {' and '.join(given) or 'none'}")
        return self

    def form(self, field: nn.Module | None = None) -> HybridForm:
        """The `HybridForm` with these constants; `field` as for `NetworkRecord.modes`."""
        modes: FieldModes
        if self.network is not None:
            modes = self.network.modes(field)
        elif field is not None:
            raise InputError("a network was given for the field, and the field of this camera is none; leave it out")
        elif self.gaussian is not None:
            modes = GaussianModes(**dict(self.gaussian))
        else:
            modes = ZernikeModes(**dict(self.modes or {}))
        return HybridForm(shape=self.shape, radius=self.radius, modes=modes, port=self.port)


class LensOrders(Record):
    """The lens model by its orders, so that the file does not depend on the names of presets.

    Args:
        numerator: see `LensModel`, as for the others.
        denominator: of the radial denominator.
        tangential: whether there are tangential terms.
        prism: of the prism terms.
        tilt: whether the sensor is tilted.
        fisheye: whether the numerator acts on the angle.
        hybrid: constants of a hybrid lens, which has no orders; None, and absent from the file, for other lenses.
    """

    _LATER: ClassVar[Mapping[str, Any]] = {"hybrid": None}

    numerator: int
    denominator: int
    tangential: bool
    prism: int
    tilt: bool
    fisheye: bool = False
    hybrid: HybridRecord | None = None

    @pydantic.model_validator(mode="after")
    def _known(self) -> LensOrders:
        if self.complete:
            self.model()
        return self

    @property
    def complete(self) -> bool:
        """Whether the file says all of the lens: not where its network is of a user's class."""
        return self._own_network is None

    @property
    def _own_network(self) -> NetworkRecord | None:
        """The network of a user's class."""
        network = None if self.hybrid is None else self.hybrid.network
        return None if network is None or network.known else network

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients."""
        network = self._own_network
        if network is None or self.hybrid is None:
            return self.model().names
        return LEADING + PORT * self.hybrid.port + network_names(network.features)

    @classmethod
    def of(cls, model: LensModel) -> LensOrders:
        """The orders of a lens model."""
        orders = {name: getattr(model, name) for name in cls.model_fields}
        return cls(**orders | {"hybrid": model.hybrid and HybridRecord.of(model.hybrid)})

    def model(self, field: nn.Module | None = None) -> LensModel:
        """The `LensModel` with these orders; `field` as for `NetworkRecord.modes`."""
        if self.hybrid is None and field is not None:
            raise InputError("a network was given for the field, and this lens has no field; leave it out")
        return LensModel(**dict(self) | {"hybrid": self.hybrid and self.hybrid.form(field)})
