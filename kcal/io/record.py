"""Blocks inside kcal's files."""

from __future__ import annotations

import base64
import binascii
import math

import numpy as np
import pydantic
import torch

from kcal.checks import as_covariance
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
