"""Run a method of a module as one operation of a compiled graph.

A solver that stops where values say so is no good graph: unrolled, the most likely position through the default lens
has 25,000 steps, which a compiler does not finish in 17 minutes. As one operation it takes seconds to compile, whatever
the shapes, and runs as fast as it does without compiling. Its derivatives are those of the method: the last call is
kept for them, and an earlier one runs once more. Exported graphs, which need no kcal where they run, have all steps.
"""

from __future__ import annotations

import contextlib
import itertools
import weakref
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

from kcal.checks import Float64Module

_MODULES: weakref.WeakValueDictionary[str, Operations] = weakref.WeakValueDictionary()
_NUMBERS = itertools.count()


class Operations(Float64Module):
    """A module some of whose methods are single operations where they are compiled.

    Attributes:
        whole_graph: set this to True to compile all steps instead: minutes, and then faster for few points.
        results: for each such method the shape behind that of the points, and the type, of each result.
    """

    whole_graph = False
    results: ClassVar[dict[str, tuple[tuple[tuple[int, ...], torch.dtype], ...]]]

    def __init__(self) -> None:
        super().__init__()
        self._enter()

    def _enter(self) -> None:
        self._recorded: tuple[int, list[Tensor], list[Tensor]] | None = None
        self._operation = f"{type(self).__name__} {next(_NUMBERS)}"
        _MODULES[self._operation] = self

    def __setstate__(self, state: dict[str, Any]) -> None:
        """A copy, or what was pickled, is another module."""
        super().__setstate__(state)
        self._enter()

    def as_operation(self, method: str, *inputs: Tensor | None) -> list[Tensor] | None:
        """The results of a method, if this call is compiled: contiguous, and without the type that contains them."""
        if self.whole_graph or not torch.compiler.is_compiling() or torch.compiler.is_exporting():
            return None
        # An operation has no derivatives in forward mode: they would be zero without a word.
        if forward_ad._current_level >= 0:
            return None
        given = "".join("-" if value is None else "x" for value in inputs)
        tensors = [*self.parameters(), *self.buffers(), *(value for value in inputs if value is not None)]
        asked = "".join("x" if torch.is_grad_enabled() and one.requires_grad else "-" for one in tensors)
        return list(_call(tensors, self._operation, method, given, asked))[:-1]


Shape = tuple[int, ...]


def shapes_of(kind: type[tuple], **other: Shape | torch.dtype | tuple[Shape, torch.dtype]) -> dict[str, Any]:
    """`Operations.results` of a `forward` that returns a named tuple: float64 numbers, but for the `other` ones."""

    def both(one: Any) -> Any:
        if isinstance(one, torch.dtype):
            return (), one
        return one if one and isinstance(one[-1], torch.dtype) else (one, torch.float64)

    return {"forward": tuple(both(other.get(name, ())) for name in kind._fields)}  # type: ignore[attr-defined]


class _Method(nn.Module):
    """A method of a module as the `forward` of another one."""

    def __init__(self, module: nn.Module, method: str) -> None:
        super().__init__()
        self.module, self.method = module, method

    def forward(self, *inputs: Tensor | None) -> Any:
        return getattr(self.module, self.method)(*inputs)


def _run(tensors: Sequence[Tensor], name: str, method: str, given: str) -> list[Tensor]:
    module = _MODULES[name]
    own = {**dict(module.named_parameters()), **dict(module.named_buffers())}
    rest = iter(tensors[len(own) :])
    inputs = [next(rest) if one == "x" else None for one in given]
    state = dict(zip(own, tensors, strict=False))
    if all(own[each].data_ptr() == one.data_ptr() and not one.requires_grad for each, one in state.items()):
        found = getattr(module, method)(*inputs)
    else:
        parts = {f"module.{each}": tensor for each, tensor in state.items()}
        found = torch.func.functional_call(_Method(module, method), parts, tuple(inputs))
    return [value.contiguous() for value in found]


# What is inside stops where values say so, which CUDA's graphs cannot record.
_TAGS: dict[str, Any] = {"tags": (torch.Tag.cudagraph_unsafe,)} if hasattr(torch.Tag, "cudagraph_unsafe") else {}


@torch.library.custom_op("kcal::call", mutates_args=(), **_TAGS)
def _call(tensors: list[Tensor], name: str, method: str, given: str, asked: str) -> list[Tensor]:
    """Call a method with parameters and buffers of the module, then those inputs that are `given`, an x for each.

    Derivatives may be wanted by the tensors that are `asked`. The last result is the number of the call.
    """
    if "x" not in asked:
        with torch.no_grad():
            found = _run([each.detach() for each in tensors], name, method, given)
        return [*found, torch.tensor(-1)]
    module, number = _MODULES[name], next(_NUMBERS)
    leaves, results = _record(tensors, name, method, given, asked)
    module._recorded = number, leaves, results
    # What a compiler does with these must not change those.
    return [*(one.detach().clone() for one in results), torch.tensor(number)]


def _record(
    tensors: Sequence[Tensor], name: str, method: str, given: str, asked: str
) -> tuple[list[Tensor], list[Tensor]]:
    """The tensors as leaves of autograd's graph, and the results in it."""
    with contextlib.ExitStack() as stack:
        # Torch records nothing inside an operation unless asked to.
        for key in ("AutogradFunctionality", "ADInplaceOrView"):
            stack.enter_context(torch._C._SetExcludeDispatchKeyGuard(getattr(torch._C.DispatchKey, key), False))
        stack.enter_context(torch.enable_grad())
        leaves = [each.detach().requires_grad_(by == "x") for each, by in zip(tensors, asked, strict=True)]
        return leaves, _run(leaves, name, method, given)


@_call.register_fake
def _empty_results(tensors: list[Tensor], name: str, method: str, given: str, asked: str) -> list[Tensor]:
    first, shapes = tensors[-given.count("x")], _MODULES[name].results[method]
    found = [first.new_empty((*first.shape[:-1], *tail), dtype=kind) for tail, kind in shapes]
    return [*found, first.new_empty((), dtype=torch.int64, device="cpu")]


@torch.library.custom_op("kcal::call_backward", mutates_args=(), **_TAGS)
def _call_backward(
    slopes: list[Tensor], tensors: list[Tensor], call: Tensor, name: str, method: str, given: str, asked: str, has: str
) -> list[Tensor]:
    """Derivatives by the tensors that are `asked`, given those by the results that have one."""
    module = _MODULES[name]
    kept, module._recorded = module._recorded, None
    if kept is None or kept[0] != int(call):
        leaves, results = _record(tensors, name, method, given, asked)
    else:
        _, leaves, results = kept
    wanted = [leaf for leaf in leaves if leaf.requires_grad]
    with_slope = [value for value, one in zip(results, has, strict=True) if one == "x"]
    # Compiled graphs bring zeros for results that are not used.
    pairs = [(a, b) for a, b in zip(with_slope, slopes, strict=True) if a.requires_grad and bool(b.any())]
    found: Sequence[Tensor | None] = [None] * len(wanted)
    if pairs:
        outputs, by_output = zip(*pairs, strict=True)
        found = torch.autograd.grad(outputs, wanted, by_output, allow_unused=True)
    both = zip(wanted, found, strict=True)
    return [leaf.new_zeros(leaf.shape) if one is None else one.contiguous() for leaf, one in both]


@_call_backward.register_fake
def _empty_slopes(
    slopes: list[Tensor], tensors: list[Tensor], call: Tensor, name: str, method: str, given: str, asked: str, has: str
) -> list[Tensor]:
    return [each.new_empty(each.shape) for each, by in zip(tensors, asked, strict=True) if by == "x"]


def _keep(ctx: Any, inputs: tuple[Any, ...], output: list[Tensor]) -> None:
    tensors, *ctx.which = inputs
    ctx.save_for_backward(*tensors, output[-1])
    ctx.set_materialize_grads(False)


def _backward(ctx: Any, slopes: list[Tensor | None]) -> tuple[Any, ...]:
    *tensors, call = ctx.saved_tensors
    has = "".join("-" if one is None else "x" for one in slopes[:-1])
    known = [one for one in slopes[:-1] if one is not None]
    found = iter(_call_backward(known, tensors, call, *ctx.which, has))
    return [next(found) if by == "x" else None for by in ctx.which[-1]], None, None, None, None


_call.register_autograd(_backward, setup_context=_keep)


@_call.register_vmap
def _over_batch(info: Any, dims: Any, tensors: list[Tensor], *which: str) -> Any:
    pairs = list(zip(tensors, dims[0], strict=True))
    rows = [
        _call([one if axis is None else one.select(axis, i) for one, axis in pairs], *which)
        for i in range(info.batch_size)
    ]
    return [torch.stack(each) for each in zip(*rows, strict=True)], [0] * len(rows[0])
