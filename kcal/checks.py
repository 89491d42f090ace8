"""Check what users pass: clear errors instead of silent broadcasting or rounding."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.utils import _pytree

from kcal.errors import InputError

# Pixels: a telescope of 100 m has 1e8.
MOST_FOCAL = 1e8
Named = TypeVar("Named", bound=type[tuple])


def exportable(result: Named) -> Named:
    """Decorate the named tuple that a module returns, so that `torch.export.save` and `load` know it by its name."""
    # Torch has no public function for named tuples, and its own classes of results are registered by this one.
    _pytree._register_namedtuple(result, serialized_type_name=f"kcal.{result.__name__}")
    return result


def as_points(name: str, value: Tensor, last: int) -> Tensor:
    """Return `value` as float64 after checking that it is a real floating tensor of shape (..., last).

    Integers are refused: a pixel rounded to an integer is a measurement thrown away, and whoever passes one should
    say so with `.double()`. float16 and bfloat16 are refused for the same reason: near 1000 px they have steps of 0.5
    and 4 px. float32 is promoted.

    Raises:
        InputError: not a tensor, not floating point, less than float32, or another last dimension.
    """
    if not isinstance(value, Tensor):
        raise InputError(f"{name}: a torch tensor is needed, got {type(value).__name__}")
    if not value.is_floating_point():
        raise InputError(f"{name}: floating point is needed, got {value.dtype}; convert with .double()")
    if torch.finfo(value.dtype).bits < 32:
        step = 512 * torch.finfo(value.dtype).eps
        raise InputError(
            f"{name}: {value.dtype} has steps of {step:g} near 1000; compute it in float32 or float64, or accept the "
            "rounding with .double()"
        )
    if value.ndim < 1 or value.shape[-1] != last:
        raise InputError(f"{name}: shape (..., {last}) is needed, got {tuple(value.shape)}")
    return value.to(torch.float64)


def require_finite(name: str, value: Tensor) -> None:
    """Raise `InputError` if any element is NaN or infinite."""
    # One pass over large images; a sum may overflow where no value is infinite.
    if bool(torch.isfinite(value.sum())):
        return
    bad = ~torch.isfinite(value)
    if bool(bad.any()):
        where = tuple(int(i) for i in bad.nonzero()[0])
        raise InputError(f"{name}: {int(bad.sum())} of {value.numel()} values are not finite, first at {where}")


def keep_float64(fn: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """Let `.to`, `.half`, `.float` move float64 tensors between devices without rounding them."""

    def moved(tensor: Tensor) -> Tensor:
        result = fn(tensor)
        return tensor.to(result.device) if tensor.dtype == torch.float64 else result

    return moved


def as_covariance(name: str, matrix: Tensor | None, size: int) -> Tensor:
    """Return `matrix` as float64 (size, size) after checking that it is a covariance; zeros for None.

    Raises:
        InputError: not a tensor, another shape, not finite, not symmetric, or with a negative eigenvalue.
    """
    if matrix is None:
        return torch.zeros(size, size, dtype=torch.float64)
    if not isinstance(matrix, Tensor) or tuple(matrix.shape) != (size, size):
        shape = tuple(matrix.shape) if isinstance(matrix, Tensor) else type(matrix).__name__
        raise InputError(f"{name}: a covariance of shape ({size}, {size}) is needed, got {shape}")
    matrix = matrix.detach().to(torch.float64)
    require_finite(name, matrix)
    # Entries have different units: compare them as correlations.
    scale = matrix.diagonal().clamp_min(0.0).sqrt()
    scale = torch.where(scale > 0, scale, 1.0)
    unit = matrix / scale[:, None] / scale
    # Rounding stays below 1e-9 per row.
    if not torch.allclose(unit, unit.T, atol=1e-9) or (size and float(torch.linalg.eigvalsh(unit)[0]) < -1e-9 * size):
        raise InputError(f"{name}: not a covariance; it must be symmetric and have no negative eigenvalue")
    return 0.5 * (matrix + matrix.T)


class Float64Module(nn.Module):
    """A module whose float64 tensors keep their precision under `.half()`, `.float()` and `.to(dtype)`."""

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:
        return super()._apply(keep_float64(fn), recurse)
