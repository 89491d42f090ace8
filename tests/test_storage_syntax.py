"""The syntax of OpenCV's and MATLAB's files: each rule, and what breaks it, with the line that is wrong."""

import io
import struct
import zlib
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from kcal.errors import FileError
from kcal.strict_formats import read_mat, read_storage, read_yaml
from kcal.strict_json import read_json, read_xml


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("a: 1", 1.0),
        ("a: -1.5e-3", -1.5e-3),
        ("a: +.5", 0.5),
        ("a: 1e", "1e"),
        ("a: .NaN?", ".NaN?"),
        ("a: -.Inf", -np.inf),
        ("a: mm # in words", "mm"),
        ("a: mm#2", "mm#2"),
        ("a:", ""),
        ("a: # nothing", ""),
        ("a: 'it''s # 1'", "it's # 1"),
        ('a: "b\\n\\"c\\" # d"', 'b\n"c" # d'),
        ("a: []", []),
        ("a: {}", {}),
        ("a: [ ]", []),
        ("a: [1, two words , 3]", [1.0, "two words", 3.0]),
        ("a: [1,\n   2,\n   3]", [1.0, 2.0, 3.0]),
        ("a: [1, [2, 3], {b: 4, \"c d\": '5'}]", [1.0, [2.0, 3.0], {"b": 4.0, "c d": "5"}]),
        ("a: {b: [1],\n c: {d: x}}", {"b": [1.0], "c": {"d": "x"}}),
        ("a: ['[', 1]", ["[", 1.0]),
        ("a: [1, 2,]", [1.0, 2.0]),
        ("a:\n- 1\n- 2", [1.0, 2.0]),
        ("a:\n  - 1\n  -\n    - 2\n    - 3", [1.0, [2.0, 3.0]]),
        ("a:\n  - b: 1\n    c: 2\n  - b: 3", [{"b": 1.0, "c": 2.0}, {"b": 3.0}]),
        ("a:\n  b:\n    c: 1\n  d: 2", {"b": {"c": 1.0}, "d": 2.0}),
        ("a: !!float 3", 3.0),
        ('"a": 1', 1.0),
        ("# first\n\n---\na: 1\n...", 1.0),
        ("%YAML:1.0\n---\na: 1", 1.0),
    ],
)
def test_yaml(text: str, value: Any) -> None:
    assert read_storage(text.encode(), "x") == {"a": value}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "it is empty"),
        ("# nothing\n---", "names with values are needed"),
        ("a: 1\nb", "could not find expected ':' in \"<unicode string>\", line 2"),
        ("a: 1\n\n   b: 2", "line 3, column 5"),
        ("a:\n  b: 1\n c: 2", "line 3, column 2"),
        ("a: 1\nb: [1] [2]", "line 2, column 8"),
        ("a: [1, 2", "expected ',' or ']'"),
        ("a: [:]", "found ':'"),
        ("a: [,]", "found ','"),
        ("a: {b: 1, b: 2}", "the name 'b' occurs twice"),
        ("a: 1\na: 2", "the name 'a' occurs twice"),
        ('a: "b', "found unexpected end of stream"),
        ('{"a": 1, "a": 2}', "the key 'a' occurs twice"),
        ("a: 'b", "found unexpected end of stream"),
        ("a: &b [1]\nc: *b", "a reference to another part"),
        ("a: 1" + " " * 2**20, "more than 1 MiB besides lists of numbers"),
        ("- 1", "names with values are needed"),
        ("a: " + "[" * 17 + "]" * 17, "nested deeper than 16 levels"),
        ("\n".join("  " * n + "a:" for n in range(17)) + " 1", "nested deeper than 16 levels"),
    ],
)
def test_wrong_yaml(text: str, message: str) -> None:
    with pytest.raises(FileError) as caught:
        read_storage(text.encode(), "x")
    assert str(caught.value).startswith("x: ")
    assert message in str(caught.value)


def test_long_lists() -> None:
    """They are read apart, with the same result: in brackets, over lines, with texts like them around."""
    numbers = [float(i) for i in range(300)]
    listed = f"[{', '.join(map(str, numbers))}]"
    broken = listed.replace(", ", ",\n     ")
    text = f'a: {listed}\nb: "x {listed}"\nc: {{d: {broken}, e: 1}}  # {listed}\nf: !!seq {listed}\n'
    found = read_storage(text.encode(), "x")
    assert found == {"a": numbers, "b": f"x {listed}", "c": {"d": numbers, "e": 1.0}, "f": numbers}
    with pytest.raises(FileError, match="line 303, column 1"):
        read_storage(f"a: 1\nb: {broken}\n\n: x".encode(), "x")
    with pytest.raises(FileError, match="x: "):
        read_storage(f"a: {listed.replace(' 7.0,', ' ,')}".encode(), "x")


def test_depth_that_is_read() -> None:
    read_storage(("a: " + "[" * 15 + "]" * 15).encode(), "x")
    read_storage(("\n".join("  " * n + "a:" for n in range(16)) + " 1").encode(), "x")


def matrix(shape: str, dt: str, data: str) -> str:
    return f"K: !!opencv-matrix\n  {shape}\n  dt: {dt}\n  data: {data}\n"


@pytest.mark.parametrize(
    ("text", "shape"),
    [
        (matrix("rows: 2\n  cols: 3", "d", "[1,2,3,4,5,6]"), (2, 3)),
        (matrix("rows: 1\n  cols: 3", '"2f"', "[1,2,3,4,5,6]"), (1, 3, 2)),
        (matrix("rows: 3\n  cols: 2", '"1u"', "[1,2,3,4,5,6]"), (3, 2)),
        (matrix("sizes: [3, 1, 2]", "i", "[1,2,3,4,5,6]"), (3, 1, 2)),
        (matrix("rows: 0\n  cols: 4", "d", "[]"), (0, 4)),
    ],
)
def test_matrices(text: str, shape: tuple[int, ...]) -> None:
    found = read_storage(text.encode(), "x")["K"]
    assert found.dtype == np.float64
    assert np.array_equal(found, np.arange(1.0, 1.0 + found.size).reshape(shape))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (matrix("rows: 2\n  cols: 3", "d", "[1,2,3,4,5]"), "a matrix of 2 x 3 with 5 numbers"),
        (matrix("rows: 1\n  cols: 2", '"3f"', "[1,2]"), "a matrix of 1 x 2 x 3 with 2 numbers"),
        (matrix("rows: 1.5\n  cols: 2", "d", "[1,2,3]"), "a matrix without rows"),
        (matrix("rows: -1\n  cols: -2", "d", "[1,2]"), "a matrix without rows"),
        (matrix("rows: 3000000000\n  cols: 0", "d", "[]"), "a matrix without rows"),
        (matrix("rows: 2", "d", "[1,2]"), "a matrix without rows"),
        (matrix("sizes: []", "d", "[1]"), "a matrix without rows"),
        (matrix("rows: 1\n  cols: 1", "z", "[1]"), "a known dt"),
        (matrix("rows: 1\n  cols: 1", "d", "[x]"), "or numbers"),
    ],
)
def test_wrong_matrices(text: str, message: str) -> None:
    with pytest.raises(FileError, match=message):
        read_storage(text.encode(), "x")


def test_xml_and_json() -> None:
    text = (
        '<?xml version="1.0"?><opencv_storage><a>1 2 3</a><b>two words</b><c>"x" 2</c><d><_>1</_><_>"y z"</_></d><K '
        'type_id="opencv-matrix"><rows>1</rows><cols>1</cols><dt>d</dt><data>5.</data></K><e/></opencv_storage>'
    )
    found = read_storage(text.encode(), "x")
    assert found.pop("K").tolist() == [[5.0]]
    assert found == {"a": [1.0, 2.0, 3.0], "b": "two words", "c": ["x", 2.0], "d": [1.0, "y z"], "e": []}
    with pytest.raises(FileError, match="occurs twice"):
        read_storage(b"<opencv_storage><a>1</a><a>2</a></opencv_storage>", "x")
    with pytest.raises(FileError, match="the root element is 'b', not opencv_storage"):
        read_storage(b"<b/>", "x")
    found = read_storage(b'{"a": [1, true, null, ".Inf"], "b": {"c": "x"}}', "x")
    assert found == {"a": [1.0, 1.0, "None", np.inf], "b": {"c": "x"}}
    assert type(found["a"][0]) is float


def test_limits_of_xml_yaml_and_json() -> None:
    assert read_xml("<a>" * 32 + "</a>" * 32, "x").tag == "a"
    assert len(read_xml("<a>" + "<b/><c/>" * 50 + "</a>", "x")) == 100
    for text, message in (("<a>" * 33 + "</a>" * 33, "x: not XML that can be read: nested deeper than 32 levels"),
                          ("<!DOCTYPE a><a/>", "document types"), ("<a>", "not XML")):  # fmt: skip
        with pytest.raises(FileError, match=message):
            read_xml(text, "x")
    assert read_yaml("a: " + "[" * 32 + "]" * 32, "x")["a"]
    bomb = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
        f"{name}: &{name} [{', '.join(['*' + former] * 10)}]\n" for former, name in zip("abcdef", "bcdefg", strict=True)
    )
    for text, message in (
        ("a: " + "[" * 33 + "]" * 33, "nested deeper than 32 levels"), ("- 1", "a mapping of names"),
        ("a: [", "no YAML file"), (bomb, "its anchors repeat more than 200,000"), ("a: &a [*a]", "or themselves"),
    ):  # fmt: skip
        with pytest.raises(FileError, match=message):
            read_yaml(text, "x")
    assert read_json(b"[" * 32 + b"]" * 32, "x")
    for data in (b"[" * 33 + b"]" * 33, b'{"a": 1, "a": 2}', b"\xff"):
        with pytest.raises(FileError, match=r"^x: "):
            read_json(data, "x")


def saved(content: dict[str, Any], packed: bool = False) -> bytes:
    file = io.BytesIO()
    savemat(file, content, do_compression=packed)
    return file.getvalue()


def element(kind: int, data: bytes, order: str = "<") -> bytes:
    return struct.pack(f"{order}II", kind, len(data)) + data + bytes(-len(data) % 8)


def array(kind: int, sides: tuple[int, ...], *parts: bytes, order: str = "<", name: bytes = b"a") -> bytes:
    flags = element(6, struct.pack(f"{order}II", kind, 0), order)
    shape = element(5, struct.pack(f"{order}{len(sides)}i", *sides), order)
    return element(14, flags + shape + element(1, name, order) + b"".join(parts), order)


def head(order: str = "<") -> bytes:
    return b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack(f"{order}HH", 0x0100, 0x4D49)


def test_mat_of_the_other_byte_order() -> None:
    doubles = element(9, struct.pack(">4d", 1, 2, 3, 4), ">")
    letters = element(4, "é1".encode("utf-16-be"), ">")
    data = head(">") + array(6, (2, 2), doubles, order=">") + array(4, (1, 2), letters, order=">", name=b"unit")
    found = read_mat(data, "x")
    assert found["a"].tolist() == [[1.0, 3.0], [2.0, 4.0]]
    assert found["a"].dtype == np.float64
    assert found["unit"] == "é1"


def test_structs_cells_and_what_is_left_out() -> None:
    content = {
        "s": np.array([(1.0, "x"), (2.0, "y")], dtype=[("v", object), ("t", object)]),
        "c": np.array([[1.0, "z"]], object),
    }
    found = read_mat(saved(content, packed=True), "x")
    assert [(part["v"].item(), part["t"]) for part in found["s"]] == [(1.0, "x"), (2.0, "y")]
    assert found["c"][1] == "z"
    # A sparse matrix is no number, and what follows it is read.
    data = head() + array(5, (1, 1)) + array(6, (1, 1), element(9, struct.pack("<d", 7.0)), name=b"b")
    assert read_mat(data, "x")["b"].tolist() == [[7.0]]
    # Numbers of one byte in small elements.
    small = struct.pack("<HH", 2, 3) + b"\1\2\3\0"
    assert read_mat(head() + array(6, (1, 3), small), "x")["a"].tolist() == [[1, 2, 3]]


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (array(6, (2, 2), element(9, bytes(24))), "a: 3 numbers for 4 places"),
        (array(6, (2, 1), element(9, bytes(15))), "half a number"),
        (array(6, (2,), element(9, bytes(16))), "an array without rows and columns"),
        (array(6, (-1, 1), element(9, bytes(8))), "an array without rows and columns"),
        (array(6, (1, 1), element(15, bytes(8))), "an element of kind 15 where numbers belong"),
        (array(4, (1, 1), element(9, bytes(8))), "characters of kind 9"),
        (array(1, (1, 1), element(9, bytes(8))), "an element of kind 9 where an array belongs"),
        (array(1, (9, 9), element(9, bytes(8))), "more elements than there are bytes"),
        (array(2, (1, 1), element(5, struct.pack("<i", 0)), element(1, b"ab")), "the names of a struct's fields"),
        (array(2, (1, 1), element(5, struct.pack("<i", 3)), element(1, b"ab\0c")), "the names of a struct's fields"),
        (array(6, (1, 1)), "it ends too early"),
        (struct.pack("<II", 14, 64) + bytes(32), "an element is longer than the file"),
        (struct.pack("<HH", 14, 5) + bytes(12), "a small element is longer than it can be"),
        (element(15, b"no zlib stream"), "not a .mat file that can be read"),
    ],
)
def test_damaged_mat(body: bytes, message: str) -> None:
    with pytest.raises(FileError, match=message):
        read_mat(head() + body, "x")


def test_limits_of_mat(monkeypatch: pytest.MonkeyPatch) -> None:
    body = array(6, (1, 1), element(9, bytes(8)))
    for _ in range(15):
        body = array(1, (1, 1), body)
    read_mat(head() + body, "x")
    with pytest.raises(FileError, match="nested deeper than 16 levels"):
        read_mat(head() + array(1, (1, 1), body), "x")
    with pytest.raises(FileError, match=r"not a \.mat file of version 5"):
        read_mat(head()[:126] + b"XY" + body, "x")
    monkeypatch.setattr("kcal.strict_formats._MOST_UNPACKED", 2**20)
    zeros = array(6, (1, 2**18), element(9, bytes(2**21)))
    for part in (zeros, struct.pack("<II", 15, len(zlib.compress(zeros))) + zlib.compress(zeros)):
        with pytest.raises(FileError, match="it unpacks to more than 1 MiB"):
            read_mat(head() + part, "x")
    half = array(6, (1, 2**16), element(9, bytes(2**19)))
    assert read_mat(head() + half, "x")["a"].shape == (1, 2**16)
    with pytest.raises(FileError, match="it unpacks to more than 1 MiB"):
        read_mat(head() + half + half, "x")
