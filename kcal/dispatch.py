"""Find out whether a call is ordinary and eager, so that it may branch on values and work in cache-sized pieces.

Under `torch.compile`, `torch.export` and `vmap` no branch may depend on values, and the compiler does its own blocking.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch._C import _functorch as functorch
from torch.autograd import forward_ad

from kcal.errors import InputError

Module = TypeVar("Module", bound=nn.Module)
# Points per piece: large enough to outweigh the cost of a call, small enough for the caches of one core.
CHUNK = 16384


def is_traced() -> bool:
    """Whether this call is being compiled or exported."""
    return torch.compiler.is_compiling() or torch.jit.is_tracing()


def known_true(mask: Tensor) -> bool:
    """Whether a mask is true everywhere; also False where values must not be read (compile, export, vmap)."""
    if is_traced():
        return False
    try:
        return bool(mask.all())
    except RuntimeError:  # vmap cannot branch on tensors
        return False


def may_branch(*tensors: Tensor) -> bool:
    """Whether Python may branch on values computed from these tensors."""
    return all(known_true(tensor.reshape(-1)[:0] == 0) for tensor in tensors)


def split_coordinates(points: Tensor) -> tuple[Tensor, ...]:
    """Split points (..., K) into K tensors (...).

    Compiled kernels get each coordinate in its own memory, because loops over interleaved ones are not vectorized; this
    makes them two to three times faster. The compiler fuses away other copies than `as_strided`.
    """
    if torch.compiler.is_compiling() and not torch.compiler.is_exporting():
        planes = points.movedim(-1, 0).contiguous()
        points = torch.as_strided(planes, planes.shape, planes.stride()).movedim(0, -1)
    return points.unbind(-1)


def finite_or(x: Tensor, y: Tensor, other_x: Tensor, other_y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Replace coordinates (..., N) that are not finite by others; also return the mask of finite ones.

    Call this before any arithmetic: 0 * NaN in the backward pass would spoil the gradients of parameters.
    """
    finite = torch.isfinite(x + y)
    if known_true(finite):
        return x, y, finite
    return torch.where(finite, x, other_x), torch.where(finite, y, other_y), finite


def is_differentiated(*entering: Tensor | nn.Module | None) -> bool:
    """Whether derivatives by anything that enters a result are being recorded, in reverse or in forward mode.

    Args:
        entering: tensors, None, and modules, of which every parameter and every buffer is asked. Ask all of them: a
            tensor that is left out has a derivative of zero, or a part of it, without a word.
    """
    tensors: list[Tensor] = []
    for each in entering:
        if isinstance(each, nn.Module):
            tensors += [*each.parameters(), *each.buffers()]
        elif each is not None:
            tensors.append(each)
    if not is_traced():
        tensors = [_below_vmap(tensor) for tensor in tensors]
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
        return True
    return not is_traced() and any(forward_ad.unpack_dual(tensor).tangent is not None for tensor in tensors)


def _below_vmap(tensor: Tensor) -> Tensor:
    """The tensor that `vmap` has wrapped: the wrapper itself never requires a gradient and has no tangent."""
    while functorch.is_batchedtensor(tensor):
        tensor = functorch.get_unwrapped(tensor)
    return tensor


def still(module: Module) -> Module:
    """The module, or where anything of it is differentiated, a copy with the same values out of every graph."""
    if not is_differentiated(module):
        return module
    tensors = [*module.parameters(), *module.buffers()]
    return copy.deepcopy(module, {id(tensor): tensor.detach() for tensor in tensors})


def host_values(tensor: Tensor) -> np.ndarray:
    """A copy of the values, also of a tensor that `torch.func.grad`, `jacrev`, `jvp` or `jacfwd` has wrapped."""
    if functorch.maybe_current_level() is None:
        return tensor.detach().cpu().numpy().copy()
    with torch._C._DisableFuncTorch():
        while functorch.is_gradtrackingtensor(tensor):
            tensor = functorch.get_unwrapped(tensor)
        return tensor.detach().cpu().numpy().copy()


def may_overwrite(*tensors: Tensor) -> bool:
    """Whether intermediate results of these tensors may be overwritten: nothing is differentiated, traced or mapped."""
    return may_branch(*tensors) and not is_differentiated(*tensors)


def in_chunks(
    function: Callable[[Tensor], tuple[Tensor, Tensor]], points: Tensor, batch: int, *, differentiated: bool
) -> tuple[Tensor, Tensor]:
    """Call `function`, which maps points (..., N, K) to values (..., N, L) and a mask (..., N), piece by piece.

    Args:
        function: what to call; it must treat each point on its own.
        points: (..., N, K).
        batch: number of cameras for each point.
        differentiated: work in one piece, because the autograd graph would keep all pieces anyway.

    Raises:
        InputError: a single point without the dimension N.
    """
    if points.ndim < 2:
        raise InputError(f"shape (..., N, {points.shape[-1]}) is needed, got {tuple(points.shape)}; write points[None]")
    count = points.shape[-2]
    size = max(1, CHUNK // max(1, batch * points[..., 0, 0].numel() if count else 1))
    if is_traced() or differentiated or count <= size:
        return function(points)
    values, masks = zip(*(function(piece) for piece in points.split(size, -2)), strict=True)
    return torch.cat(values, -2), torch.cat(masks, -1)
