"""A device that computes on the CPU, and refuses to meet tensors of the CPU as a GPU does: no GPU is needed to test.

Tensors of it carry their values. They say that they are on `DEVICE`; NumPy cannot read them, and operations with
tensors of the CPU raise, except for scalars and for index tensors, as with CUDA.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils import _pytree as pytree
from torch.utils._mode_utils import no_dispatch
from torch.utils._python_dispatch import TorchDispatchMode

# The only device without hardware for which autograd has a guard.
DEVICE = torch.device("meta")
_aten = torch.ops.aten
_INDEXED = {_aten.index.Tensor, _aten.index_put.default, _aten.index_put_.default, _aten._index_put_impl_.default}
_COPIES = {_aten._to_copy.default, _aten.copy_.default}


class _There(Tensor):
    """A tensor of the device; `here` has its values."""

    here: Tensor

    @staticmethod
    def __new__(cls, here: Tensor) -> _There:
        made: _There = Tensor._make_wrapper_subclass(
            cls, here.size(), strides=here.stride(), storage_offset=here.storage_offset(), dtype=here.dtype,
            device=DEVICE, requires_grad=False,
        )  # fmt: skip
        made.here = here
        return made

    def __init__(self, here: Tensor) -> None:
        pass

    def __repr__(self) -> str:  # type: ignore[override]
        return f"there({self.here!r})"

    def tolist(self) -> Any:
        return self.cpu().tolist()

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


class _FromNumbers(TorchFunctionMode):
    """`torch.tensor`, `new_tensor` and lists as indices, which dispatch nothing."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func is Tensor.new_tensor:
            kwargs = {"dtype": args[0].dtype, "device": args[0].device, **kwargs}
            func, args = torch.tensor, args[1:]
        if func in (torch.tensor, torch.as_tensor) and not isinstance(args[0], Tensor):
            device = kwargs.pop("device", None)
            return func(*args, **kwargs).to(device)
        if func in (Tensor.__getitem__, Tensor.__setitem__):
            parts = args[1] if isinstance(args[1], tuple) else (args[1],)
            places = tuple(torch.tensor(p, dtype=torch.long) if isinstance(p, list | tuple) else p for p in parts)
            args = (args[0], places if len(places) > 1 else places[0], *args[2:])
        return func(*args, **kwargs)


class Elsewhere(TorchDispatchMode):
    """While it is active, `torch.zeros(3, device=DEVICE)` and `tensor.to(DEVICE)` give tensors of the device."""

    def __enter__(self) -> Any:
        self.numbers = _FromNumbers()
        self.numbers.__enter__()
        return super().__enter__()

    def __exit__(self, *error: Any) -> Any:
        super().__exit__(*error)
        self.numbers.__exit__(*error)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [value for value in pytree.tree_leaves((args, kwargs)) if isinstance(value, Tensor)]
    there = any(isinstance(value, _There) for value in tensors)
    wanted = kwargs.get("device")
    if there and func not in _INDEXED | _COPIES:
        for value in tensors:
            if not isinstance(value, _There) and value.ndim:
                raise RuntimeError(f"{func}: a tensor of the CPU of shape {tuple(value.shape)} meets one of the device")
    lost = any(not isinstance(value, _There) and value.device == DEVICE for value in tensors)
    assert not (there and lost), f"{func}: values were lost"
    # What autograd infers of the shapes of its zeros, on the device whose name is borrowed here.
    if lost or func.overloadpacket is _aten.to:
        return func(*args, **kwargs)
    there = there if wanted is None else torch.device(wanted) == DEVICE
    if func is _aten.copy_.default:
        there = isinstance(args[0], _There)
    if func is _aten._local_scalar_dense.default:
        there = False
    inner = pytree.tree_map_only(_There, lambda value: value.here, (args, kwargs))
    if "device" in kwargs:
        inner[1]["device"] = torch.device("cpu") if wanted is not None else None
    out = func(*inner[0], **inner[1])
    if not there:
        return out
    if torch.Tag.inplace_view in func.tags:
        with no_dispatch():
            return func(*args, **kwargs)  # the shape of the wrapper itself
    owner = {id(value.here): value for value in tensors if isinstance(value, _There)}
    return pytree.tree_map_only(Tensor, lambda value: owner[id(value)] if id(value) in owner else _There(value), out)
