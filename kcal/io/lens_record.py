"""The lens model inside kcal's camera files."""

from __future__ import annotations

from typing import Any

import pydantic

from kcal.io.record import Record
from kcal.lens.hybrid_terms import HybridForm
from kcal.lens.model import LensModel
from kcal.lens.zernike import ZernikeModes


class ZernikeRecord(Record):
    """The modes of a hybrid lens by their highest degrees (`kcal.lens.zernike.ZernikeModes`)."""

    radial: int
    decentered: int
    astigmatic: int
    other: int


class HybridRecord(Record):
    """The constants of a hybrid lens (`kcal.lens.hybrid_terms.HybridForm`).

    Args:
        shape: of the base projection.
        radius: of the disc of the field, on the plane of the base projection.
        modes: of the field.
    """

    shape: float
    radius: float
    modes: ZernikeRecord


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

    @pydantic.model_serializer(mode="wrap")
    def _without_empty_hybrid(self, plain: pydantic.SerializerFunctionWrapHandler) -> dict[str, Any]:
        stored: dict[str, Any] = plain(self)
        if stored["hybrid"] is None:
            del stored["hybrid"]
        return stored

    @classmethod
    def of(cls, model: LensModel) -> LensOrders:
        """The orders of a lens model."""
        return cls.model_validate(model, from_attributes=True)

    def model(self) -> LensModel:
        """The `LensModel` with these orders."""
        orders = dict(self)
        if self.hybrid is not None:
            orders["hybrid"] = HybridForm(
                shape=self.hybrid.shape,
                radius=self.hybrid.radius,
                modes=ZernikeModes(**dict(self.hybrid.modes)),
            )
        return LensModel(**orders)
