"""The lens model inside kcal's camera files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import pydantic

from kcal.lens.gaussian_modes import GaussianModes
from kcal.lens.hybrid_terms import HybridForm
from kcal.lens.model import LensModel
from kcal.lens.network_modes import NetworkModes
from kcal.lens.zernike import ZernikeModes
from kcal.native_file import Record


class ZernikeRecord(Record):
    """The modes of a hybrid lens by their highest degrees (`kcal.lens.zernike.ZernikeModes`)."""

    radial: int
    decentered: int
    astigmatic: int
    other: int


class GaussianRecord(Record):
    """Gaussian units by their widths (`kcal.lens.gaussian_modes.GaussianModes`)."""

    widths: tuple[float, ...]


class NetworkRecord(Record):
    """A fixed hidden layer: a, b, c of each feature (`kcal.lens.network_modes.NetworkModes`)."""

    hidden: tuple[tuple[float, float, float], ...]


# The key under which a file has each kind of field.
_KINDS: dict[str, tuple[type[Record], type]] = {
    "modes": (ZernikeRecord, ZernikeModes),
    "gaussian": (GaussianRecord, GaussianModes),
    "network": (NetworkRecord, NetworkModes),
}


class HybridRecord(Record):
    """The constants of a hybrid lens (`kcal.lens.hybrid_terms.HybridForm`).

    Args:
        shape: of the base projection.
        radius: of the disc of the field, on the plane of the base projection.
        modes: of the field, if they are Zernike modes; exactly one of this and the following is in a file.
        gaussian: of the field, if it is made of Gaussian units.
        network: of the field, if it is the last layer of a network.
    """

    _LATER: ClassVar[Mapping[str, Any]] = dict.fromkeys(_KINDS)

    shape: float
    radius: float
    modes: ZernikeRecord | None = None
    gaussian: GaussianRecord | None = None
    network: NetworkRecord | None = None

    @classmethod
    def of(cls, form: HybridForm) -> HybridRecord:
        """The constants of a lens."""
        key, record = next((key, record) for key, (record, kind) in _KINDS.items() if isinstance(form.modes, kind))
        fields = {key: record.model_validate(form.modes, from_attributes=True)}
        return cls.model_validate({"shape": form.shape, "radius": form.radius, **fields})

    def form(self) -> HybridForm:
        """The `HybridForm` with these constants."""
        given = [key for key in _KINDS if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError(f"a field has one kind, {' or '.join(_KINDS)}; got {' and '.join(given) or 'none'}")
        modes = _KINDS[given[0]][1](**dict(getattr(self, given[0])))
        return HybridForm(shape=self.shape, radius=self.radius, modes=modes)


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
        self.model()
        return self

    @classmethod
    def of(cls, model: LensModel) -> LensOrders:
        """The orders of a lens model."""
        orders = {name: getattr(model, name) for name in cls.model_fields}
        return cls(**orders | {"hybrid": model.hybrid and HybridRecord.of(model.hybrid)})

    def model(self) -> LensModel:
        """The `LensModel` with these orders."""
        return LensModel(**dict(self) | {"hybrid": self.hybrid and self.hybrid.form()})
