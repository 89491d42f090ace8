"""kcal's parsers of OpenCV's and MATLAB's files read what the programs themselves write and read."""

import io
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from kcal.errors import FileError
from kcal.strict_formats import read_mat, read_storage


def stored(kind: str) -> tuple[bytes, dict[str, Any]]:
    """A file that OpenCV writes, and what is in it."""
    points = np.random.default_rng(0).normal(size=(3, 5, 2))
    matrices = {"K": np.arange(9.0).reshape(3, 3) / 7, "points": points, "empty": np.zeros((0, 0)),
                "row": np.arange(200, dtype=np.uint8).reshape(2, 100)}  # fmt: skip
    file = cv2.FileStorage(kind, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    file.write("width", 640)
    file.write("small", 1.5e-7)
    file.write("text", 'a b: [c] "q" # 7')
    if kind != ".json":
        file.writeComment("a comment")
    for name, matrix in matrices.items():
        file.write(name, matrix)
    for name, flow in (("list", 0), ("line", cv2.FileNode_FLOW)):
        file.startWriteStruct(name, cv2.FileNode_SEQ + flow)
        file.write("", 1)
        file.write("", -2.5)
        file.endWriteStruct()
    file.startWriteStruct("maps", cv2.FileNode_SEQ)
    for number in range(2):
        file.startWriteStruct("", cv2.FileNode_MAP)
        file.write("a", number)
        file.write("m", np.eye(2))
        file.endWriteStruct()
    file.endWriteStruct()
    return file.releaseAndGetString().encode(), matrices


@pytest.mark.parametrize("kind", [".yml", ".xml", ".json"])
def test_what_opencv_writes(kind: str) -> None:
    text, matrices = stored(kind)
    found = read_storage(text, "x")
    assert (found["width"], found["small"], found["list"], found["line"]) == (640.0, 1.5e-7, [1.0, -2.5], [1.0, -2.5])
    assert kind == ".xml" or found["text"] == 'a b: [c] "q" # 7'
    for name, matrix in matrices.items():
        assert found[name].shape == matrix.shape
        assert np.array_equal(found[name], matrix)
    assert [part["a"] for part in found["maps"]] == [0.0, 1.0]
    assert np.array_equal(found["maps"][1]["m"], np.eye(2))


@pytest.mark.parametrize("kind", [".yml", ".xml"])
def test_numbers_that_are_none(kind: str) -> None:
    file = cv2.FileStorage(kind, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    file.write("n", np.array([[np.nan, np.inf, -np.inf]]))
    found = read_storage(file.releaseAndGetString().encode(), "x")["n"]
    assert np.array_equal(found, [[np.nan, np.inf, -np.inf]], equal_nan=True)


@pytest.mark.parametrize("packed", [False, True])
def test_what_matlab_and_scipy_write(packed: bool) -> None:
    numbers = {f"n{kind}": np.arange(12).reshape(2, 3, 2).astype(kind) for kind in ("f8", "f4", "i1", "u2", "i8")}
    inside = {"K": np.eye(3), "unit": "mm", "deep": {"empty": np.zeros((0, 2)), "text": "für"}}
    file = io.BytesIO()
    savemat(file, {**numbers, "s": inside, "cell": np.array([1.5, "x"], dtype=object), "b": True},
            do_compression=packed)  # fmt: skip
    found = read_mat(file.getvalue(), "x")
    for name, values in numbers.items():
        assert np.array_equal(found[name], values)
    assert found["s"]["unit"] == "mm"
    assert found["s"]["deep"]["text"] == "für"
    assert found["s"]["deep"]["empty"].shape == (0, 2)
    assert np.array_equal(found["s"]["K"], np.eye(3))
    assert found["cell"][0].item() == 1.5
    assert found["cell"][1] == "x"


def test_other_versions_of_mat_files() -> None:
    file = io.BytesIO()
    savemat(file, {"a": np.eye(2)}, format="4")
    for data, what in ((file.getvalue(), "version 5 to 7.2"), (b"MATLAB 7.3 MAT-file" + bytes(200), "version 7.3"),
                       (b"\x89HDF" + bytes(200), "version 7.3")):  # fmt: skip
        with pytest.raises(FileError, match=what):
            read_mat(data, "x")
