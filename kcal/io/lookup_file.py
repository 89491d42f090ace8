"""Lookup cameras as .npz files, for consumers that know no lens formulas, no nets and no torch.

What a file contains (numpy arrays, read with `np.load(path, allow_pickle=False)`):

| name | shape, type | meaning |
|---|---|---|
| `kcal`, `version` | text, integer | `"lookup"`, 1 |
| `image_size` | (2,) integers | width, height |
| `center` | (2,) float64 | principal point, pixels |
| `bound` | (2,) float64 | largest error in pixels of project, of unproject |
| `coverage` | (2,) float64 | share of the image's pixels with a ray that each answers for |
| `source` | text | fingerprint of the camera that was baked |
| `project_*`, `unproject_*` | | a spline each: |
| `*_coefficients` | (2, rows + 3, columns + 3) float64 | coefficients of both values |
| `*_origin`, `*_step` | (2,) float64 | place of the first coefficient and distance of the next, x then y |
| `*_cells` | (rows, columns) bool | which cells may be used |

How to read a value at (x, y): t = ((x, y) - origin) / step; (i, j) = floor(t), which must be 1 to columns and 1 to rows
(on the far edge itself, take the last cell); f = t - (i, j). If `cells[j - 1, i - 1]`, each of the two values is the
sum over the coefficients [j - 1 + m, i - 1 + n], m and n from 0 to 3, times b_m(f_y) b_n(f_x) with

    b_0 = (1 - f)³ / 6,  b_1 = (3 f³ - 6 f² + 4) / 6,  b_2 = (-3 f³ + 3 f² + 3 f + 1) / 6,  b_3 = f³ / 6

`unproject` takes a pixel and gives a position (p, q) of the stereographic chart: with s = (p² + q²) / 4, the ray is
(p, q, 1 - s) / (1 + s). `project` takes (p, q) = 2 (X, Y) / (√(X² + Y² + Z²) + Z) and gives the pixel; it is valid if
it also lies in the image, from -0.5 to width - 0.5 and height - 0.5. Pixel (0, 0) is the center of the first pixel;
x right, y down, z forward.
"""

from __future__ import annotations

import importlib.util
import io
import math
import os
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from kcal.checks import as_points
from kcal.errors import FileError, InputError
from kcal.file_kind import check_pixel_count
from kcal.files import check_writable, read_bytes, write_atomic
from kcal.lens.baking import LookupCamera, Spline
from kcal.strict_formats import read_npz

KIND, VERSION = "lookup", 1
# Tables of 700 cells each way take 16 MB.
_MOST_BYTES = 256 * 2**20
_TABLES = {"project": "pixels_from_chart", "unproject": "chart_from_pixels"}


def save_lookup(camera: LookupCamera, path: str | Path) -> Path:
    """Write a lookup camera as .npz; the module's docstring lists the arrays.

    Raises:
        FileError: the file cannot be written.

    Example:
        >>> import tempfile
        >>> from kcal import Camera
        >>> from kcal.lens import bake
        >>> lookup = bake(Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole"))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = save_lookup(lookup, Path(folder, "camera.npz"))
        ...     load_lookup(path).size, np.load(path)["image_size"].tolist()
        ((640, 480), [640, 480])
    """
    arrays = {
        "kcal": np.array(KIND), "version": np.array(VERSION), "image_size": np.array(camera.size),
        "center": camera.center.cpu().numpy(), "bound": np.array(camera.bound), "coverage": np.array(camera.coverage),
        "source": np.array(camera.source),
    }  # fmt: skip
    for name, attribute in _TABLES.items():
        table: Spline = getattr(camera, attribute)
        for part, value in table._asdict().items():
            arrays[f"{name}_{part}"] = value.cpu().numpy()
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    return write_atomic(path, buffer.getvalue())


def load_lookup(path: str | Path) -> LookupCamera:
    """Read a lookup camera; nothing in the file is executed.

    Raises:
        FileError: missing, no .npz, another kind or version, or arrays that are missing or do not fit.

    Example:
        >>> load_lookup("no-such-file.npz")
        Traceback (most recent call last):
        kcal.errors.FileError: no-such-file.npz: cannot read: No such file or directory
    """
    arrays = read_npz(read_bytes(path, _MOST_BYTES), str(path), _MOST_BYTES, "lookup camera")
    kind, version = arrays.get("kcal"), arrays.get("version")
    if kind is None or str(kind) != KIND or version is None or str(version) != str(VERSION):
        raise FileError(f"{path}: not a kcal {KIND} file of version {VERSION}")
    try:
        tables = {}
        for name, attribute in _TABLES.items():
            parts = {part: torch.from_numpy(arrays[f"{name}_{part}"]) for part in Spline._fields}
            tables[attribute] = Spline(**parts)
            numbers = [parts["coefficients"], parts["origin"], parts["step"]]
            if not all(n.dtype == torch.float64 and bool(n.isfinite().all()) for n in numbers):
                raise InputError(f"{name}: numbers must be finite and float64")
            if parts["cells"].dtype != torch.bool or parts["cells"].numel() == 0 or not bool((parts["step"] > 0).all()):
                raise InputError(f"{name}: cells must be bool, at least one, and steps positive")
            if any(parts[part].shape != (2,) for part in ("origin", "step")):
                raise InputError(f"{name}: origin and step have two numbers each")
        width, height = _two(arrays, "image_size", "iu", 1, math.inf)
        return LookupCamera(
            size=check_pixel_count((int(width), int(height))),
            center=torch.tensor(_two(arrays, "center", "f", -math.inf, math.inf), dtype=torch.float64),
            bound=_two(arrays, "bound", "f", 0.0, math.inf), coverage=_two(arrays, "coverage", "f", 0.0, 1.0),
            source=str(arrays["source"]), **tables,
        )  # fmt: skip
    except KeyError as error:
        raise FileError(f"{path}: bad lookup file: {error.args[0]} is missing") from error
    except (InputError, ValueError, TypeError, IndexError) as error:
        raise FileError(f"{path}: bad lookup file: {error}") from error


def _two(arrays: dict[str, np.ndarray], key: str, kinds: str, low: float, high: float) -> tuple[float, float]:
    values = arrays[key]
    if values.shape != (2,) or values.dtype.kind not in kinds:
        raise ValueError(f"{key}: two numbers are needed, got shape {values.shape} of {values.dtype}")
    first, second = values.tolist()
    if not (low <= min(first, second) and max(first, second) <= high and math.isfinite(first + second)):
        raise ValueError(f"{key} is {first:g}, {second:g}; finite numbers from {low:g} to {high:g} are needed")
    return first, second


# Modules of points as ONNX files, for runtimes other than torch.


def save_onnx(module: nn.Module, example: Tensor | Sequence[Tensor], path: str | Path) -> Path:
    """Write a module that maps points (N, K) as ONNX, for any number of points from two up.

    `Camera` itself is such a module (`project`); `Unproject`, `LookupCamera` and `Localizer` (without a
    covariance) are others. The graph is written as it was traced, and its numbers in float64: the optimizer
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
                    module.eval(), examples, written, dynamo=True, dynamic_shapes=tuple({0: count} for _ in examples),
                    external_data=False, optimize=False, verbose=False,
                    custom_translation_table={torch.ops.aten.scalar_tensor.default: _scalar_tensor},
                )  # fmt: skip
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
