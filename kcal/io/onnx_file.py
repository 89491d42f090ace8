"""Modules of points as ONNX files, for runtimes other than torch."""

from __future__ import annotations

import importlib.util
import os
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from kcal.checks import as_points
from kcal.errors import FileError, InputError
from kcal.files import check_writable


def save_onnx(module: nn.Module, example: Tensor | Sequence[Tensor], path: str | Path) -> Path:
    """Write a module that maps points (N, K) as ONNX, for any number of points from two up.

    `Camera` itself is such a module (`project`); `Unproject`, `LookupCamera`, `Triangulate` and `StereoLocalizer`
    (without a covariance) are others. The graph is written as it was traced, and its numbers in float64: the optimizer
    of onnxscript 0.7, on by default in `torch.onnx.export`, takes constants within 1e-5 of one for one and below 1e-8
    for zero, and so drops the cosine of a small tilt or a small coefficient without a word. Runtimes optimize on their
    own when they load the graph.

    Args:
        module: its parameters become constants.
        example: (N, K) points to trace it with, at least two; several such tensors for a module of several inputs.
        path: of the file.

    Raises:
        InputError: points of another shape, or the extra `onnx` is not installed.
        FileError: the file cannot be written.

    Example:
        >>> import tempfile
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_onnx(camera, torch.ones(2, 3), Path(folder, "camera.onnx")).name
        'camera.onnx'
    """
    path = check_writable(path)
    examples = (example,) if isinstance(example, Tensor) else tuple(example)
    if not examples or any(some.ndim != 2 or len(some) < 2 or len(some) != len(examples[0]) for some in examples):
        raise InputError("save_onnx: an example (N, K) of at least two points is needed, the same N for every input")
    examples = tuple(as_points("example", some, some.shape[-1]) for some in examples)
    count = torch.export.Dim("count", min=2)
    if importlib.util.find_spec("onnxscript") is None:
        raise InputError("save_onnx: onnx and onnxscript are needed; install kcal[onnx]")
    training = module.training
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
            written = Path(folder, path.name)
            with warnings.catch_warnings():
                # Of torch's own use of its tree library, nothing that a user could change.
                warnings.simplefilter("ignore", FutureWarning)
                # Two inputs share one number of points, which is what is wanted.
                warnings.filterwarnings("ignore", message="# The axis name")
                torch.onnx.export(
                    module.eval(),
                    examples,
                    written,
                    dynamo=True,
                    dynamic_shapes=tuple({0: count} for _ in examples),
                    external_data=False,
                    optimize=False,
                    verbose=False,
                    custom_translation_table={torch.ops.aten.scalar_tensor.default: _scalar_tensor},
                )
            os.replace(written, path)
    except OSError as error:
        raise FileError(f"{path}: cannot write: {error.strerror or error}") from error
    finally:
        module.train(training)
    return path


def _scalar_tensor(s: Any, dtype: int = -1, layout: str = "", device: str = "", pin_memory: bool = False) -> Any:
    """A number of the graph in its own precision; by default onnxscript 0.7 rounds every plain number to float32."""
    from onnx import TensorProto, helper
    from onnxscript import opset18

    kind = TensorProto.FLOAT if dtype == -1 else dtype
    if isinstance(s, bool | int | float):
        return opset18.Constant(value=helper.make_tensor("number", kind, [], [s]))
    return opset18.Cast(s, to=kind)
