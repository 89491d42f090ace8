"""Checks of tensors, and limits of chance."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn
from torch.utils import _pytree

from kcal.errors import InputError
from kcal.texts import brief

# Check what users pass: clear errors instead of silent broadcasting or rounding.

# Pixels: a telescope of 100 m has 1e8.
MOST_FOCAL = 1e8
Named = TypeVar("Named", bound=type[tuple])


def exportable(result: Named) -> Named:
    """Decorate the named tuple that a module returns, so that `torch.export.save` and `load` know it by its name."""
    # Torch has no public function for named tuples, and its own classes of results are registered by this one.
    _pytree._register_namedtuple(result, serialized_type_name=f"kcal.{result.__name__}")
    return result


def as_tensor(name: str, value: Tensor | ArrayLike) -> Tensor:
    """Return a tensor as it is, and numbers of other kinds as a new tensor on the CPU.

    Those are arrays of NumPy, what turns into one (such as columns of a table), and lists of numbers. Whole numbers of
    a list are taken as exact; an array keeps its type, so that `as_points` can refuse one of integers.

    Raises:
        InputError: a unit, a mask, objects, texts, or lists of unlike lengths.

    Example:
        >>> as_tensor("pixels", [[960, 540]])
        tensor([[960., 540.]], dtype=torch.float64)
    """
    if isinstance(value, Tensor):
        return value
    if (unit := getattr(value, "unit", getattr(value, "units", None))) is not None:
        raise InputError(
            f"{name}: plain numbers are needed, these are in {unit}; convert to meters or pixels, unit off"
        )
    if np.ma.isMaskedArray(value):
        raise InputError(f"{name}: a masked array would lose its mask; use .filled(numpy.nan) or leave those rows out")
    try:
        array = np.asarray(value)
    except (ValueError, TypeError, RuntimeError) as error:
        # Of unlike lengths, or tensors that a list would cut off from their gradients.
        raise InputError(
            f"{name}: one array is needed, got a {type(value).__name__} ({error}); use torch.stack"
        ) from error
    if array.dtype.kind not in "fiu":
        what = f" of {array.dtype}; convert with .astype(float)" if array.ndim else ""
        raise InputError(f"{name}: a tensor or array of numbers is needed, got {type(value).__name__}{what}")
    exact = array.dtype.itemsize > 2 if array.dtype.kind == "f" else isinstance(value, list | tuple | int)
    kept = np.float64 if exact else np.float16 if array.dtype.kind == "f" else np.int64
    return torch.from_numpy(np.array(array, kept, order="C"))


def as_points(
    name: str, value: Tensor | ArrayLike, last: int, like: Tensor | None = None, otherwise: str = ""
) -> Tensor:
    """Return `value` as float64 after checking that it is real, floating, and of shape (..., last).

    Integers are refused: a pixel rounded to an integer is a measurement thrown away, and whoever passes one should
    say so with `.double()`. float16 and bfloat16 are refused for the same reason: near 1000 px they have steps of 0.5
    and 4 px. float32 is promoted. Arrays and lists are converted by `as_tensor`, to the device of `like`. `otherwise`
    says what to call for something of another shape.

    Raises:
        InputError: no numbers, not floating point, less than float32, another last dimension, or a tensor on another
            device than `like`.
    """
    points = as_tensor(name, value)
    if not points.is_floating_point():
        cure = ".double()" if isinstance(value, Tensor) else ".astype(float)"
        raise InputError(f"{name}: floating point is needed, got {points.dtype}; convert with {cure}")
    if torch.finfo(points.dtype).bits < 32:
        step = 512 * torch.finfo(points.dtype).eps
        raise InputError(
            f"{name}: {points.dtype} has steps of {step:g} near 1000; compute it in float32 or float64, or accept the "
            "rounding with .double()"
        )
    if points.ndim < 1 or points.shape[-1] != last:
        turned = points.ndim == 2 and points.shape[0] == last
        hint = "transpose it" if turned else otherwise
        raise InputError(
            "; ".join(filter(None, [f"{name}: shape (..., {last}) is needed, got {tuple(points.shape)}", hint]))
        )
    if like is not None and points.device != like.device:
        if isinstance(value, Tensor):
            raise InputError(
                f"{name}: on {points.device}, the parameters on {like.device}; move one of them with .to()"
            )
        points = points.to(like.device)
    return points.to(torch.float64)


def expanded(name: str, value: Tensor, shape: tuple[int, ...]) -> Tensor:
    """`value`, broadcast to a shape.

    Raises:
        InputError: its shape does not broadcast to that one.
    """
    own = tuple(value.shape)
    if len(own) > len(shape) or not all(a == 1 or a == b for a, b in zip(reversed(own), reversed(shape), strict=False)):
        raise InputError(f"{name}: a shape that broadcasts to {tuple(shape)} is needed, got {own}")
    return value.expand(shape)


def as_size(size: Any) -> tuple[int, int]:
    """Return (width, height) as two plain numbers.

    Raises:
        InputError: not two whole numbers that are positive.

    Example:
        >>> as_size(np.array([1920.0, 1080.0]))
        (1920, 1080)
    """
    try:
        width, height = (float(side) for side in size)
    except (TypeError, ValueError, RuntimeError):
        width = height = 0.0
    if not (width >= 1 and height >= 1 and width.is_integer() and height.is_integer()):
        raise InputError(
            f"image size: (width, height) in pixels is needed, both positive and whole, got {size!r:.80}; of an image "
            "in an array it is image.shape[1::-1]"
        )
    return int(width), int(height)


def require_finite(name: str, value: Tensor) -> None:
    """Raise `InputError` if any element is NaN or infinite."""
    # One pass over large images; a sum may overflow where no value is infinite.
    if bool(torch.isfinite(value.sum())):
        return
    bad = ~torch.isfinite(value)
    if bool(bad.any()):
        where = tuple(int(i) for i in bad.nonzero()[0])
        raise InputError(f"{name}: {int(bad.sum())} of {value.numel()} values are not finite, first at {where}")


def require_root(name: str, root: Tensor, size: int) -> None:
    """Raise `InputError` unless `root` is (K, size), and rootᵀ root is finite."""
    if root.ndim != 2 or root.shape[1] != size:
        raise InputError(f"{name}: a root (K, {size}) is needed, got {tuple(root.shape)}")
    require_finite(name, root)
    if not bool(root.detach().square().sum().isfinite()):
        raise InputError(f"{name}: the covariance overflows; the largest element of its root is {root.abs().max():.1e}")


def keep_float64(fn: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """Let `.to`, `.half`, `.float` move float64 tensors between devices without rounding them."""

    def moved(tensor: Tensor) -> Tensor:
        result = fn(tensor)
        return tensor.to(result.device) if tensor.dtype == torch.float64 else result

    return moved


def as_covariance(name: str, matrix: Tensor | ArrayLike | None, size: int) -> Tensor:
    """Return `matrix` as float64 (size, size) after checking that it is a covariance; zeros for None.

    Raises:
        InputError: no numbers, another shape, not finite, not symmetric, or with a negative eigenvalue.
    """
    if matrix is None:
        return torch.zeros(size, size, dtype=torch.float64)
    matrix = as_tensor(name, matrix)
    if tuple(matrix.shape) != (size, size):
        raise InputError(f"{name}: a covariance of shape ({size}, {size}) is needed, got {tuple(matrix.shape)}")
    matrix = matrix.to(torch.float64)
    plain = matrix.detach()
    require_finite(name, plain)
    # Entries have different units: compare them as correlations.
    scale = plain.diagonal().clamp_min(0.0).sqrt()
    scale = torch.where(scale > 0, scale, 1.0)
    unit = plain / scale[:, None] / scale
    # Rounding stays below 1e-9 per row.
    if not torch.allclose(unit, unit.T, atol=1e-9) or (size and float(torch.linalg.eigvalsh(unit)[0]) < -1e-9 * size):
        raise InputError(f"{name}: not a covariance; it must be symmetric and have no negative eigenvalue")
    return 0.5 * matrix + 0.5 * matrix.T  # the sum itself may overflow


class Float64Module(nn.Module):
    """A module whose float64 tensors keep their precision under `.half()`, `.float()` and `.to(dtype)`."""

    __repr__ = brief

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:
        return super()._apply(keep_float64(fn), recurse)


def scalar(value: float | Tensor, like: Tensor) -> Tensor:
    """A float64 number beside a tensor; one with a graph keeps it."""
    return torch.as_tensor(value, dtype=torch.float64, device=like.device)


class StatedModule(Float64Module):
    """A module whose state also says what it is made for, and refuses the state of one that was made otherwise.

    `constants` are what results depend on besides tensors. They are stored as a tensor of their text, so that a state
    is safe to load and fits into safetensors. A state of version 1.0 has none and is taken as it is.
    """

    @property
    def constants(self) -> object:
        """Plain numbers, words and options."""
        raise NotImplementedError

    def get_extra_state(self) -> Tensor:
        """The text of the constants, as bytes."""
        return torch.tensor(list(repr(self.constants).encode()), dtype=torch.uint8)

    def set_extra_state(self, state: Tensor) -> None:
        """Refuse other constants.

        Raises:
            InputError: the state is that of a module that was made otherwise.
        """
        found, own = bytes(state.tolist()).decode(), repr(self.constants)
        if found != own:
            raise InputError(
                f"{type(self).__name__}: the state is of one made with {found}, this one was made with {own}; make it "
                "in the same way before the state is loaded"
            )

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        state_dict.setdefault(f"{prefix}_extra_state", self.get_extra_state())
        super()._load_from_state_dict(state_dict, prefix, *rest)


# How large a sum of squared residuals may be by chance: the χ² distribution, by SciPy.

# A χ² that is less probable is no chance: one in a thousand good data sets is above it.
_LIKELY = 0.999


def chi2_quantile(freedom: Tensor | float, probability: float) -> Tensor:
    """Quantile of the χ² distribution; 0 without freedom.

    Args:
        freedom: degrees of freedom, of any shape; they need not be whole numbers.
        probability: that χ² is smaller.

    Example:
        >>> round(float(chi2_quantile(10, 0.999)), 2)
        29.59
    """
    # Not at the top: commands that never ask start faster. Torch's own function errs by 5e-10, which rigs would show.
    from scipy.special import chdtri

    given = torch.as_tensor(freedom, dtype=torch.float64)
    found = torch.as_tensor(chdtri(given.clamp_min(1e-9).numpy(), 1.0 - probability))
    return torch.where(given > 0, found, 0.0)


def chi2_tail(chi2: Tensor | float, freedom: Tensor | float) -> Tensor:
    """Probability of a χ² as large or larger by chance; 1 without freedom.

    Example:
        >>> round(float(chi2_tail(29.59, 10)), 5)
        0.001
    """
    chi2, freedom = (torch.as_tensor(value, dtype=torch.float64) for value in (chi2, freedom))
    return torch.where(freedom > 0, torch.special.gammaincc(0.5 * freedom, 0.5 * chi2.clamp_min(0.0)), 1.0)


def beyond_chance(chi2: float, freedom: float) -> bool:
    """Whether a χ² is larger than chance makes it once in a thousand times; never without freedom.

    Example:
        >>> beyond_chance(10.8, 1), beyond_chance(10.9, 1)
        (False, True)
    """
    return freedom > 0 and float(chi2_tail(chi2, freedom)) < 1.0 - _LIKELY


def variance_factor(chi2: float, freedom: float) -> float:
    """By how much stated variances must be multiplied, because residuals are larger than chance explains; 1 at least.

    The variance of unit weight of an adjustment, where a χ² test at one in a thousand rejects that it is 1.

    Example:
        >>> variance_factor(12.0, 10), variance_factor(40.0, 10)
        (1.0, 4.0)
    """
    return chi2 / freedom if beyond_chance(chi2, freedom) else 1.0
