"""Standard deviations of marks: those that are stated, those that are assumed, and none without a mark."""

import math
from pathlib import Path

import pytest
import torch

from kcal.errors import FileError
from kcal.locate.marks import Marks, read_marks, write_marks

HEADER = "name,left_u,left_v,right_u,right_v\n"


def write(folder: Path, text: str | bytes) -> Path:
    path = folder / "points.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def test_reads_names_and_pixels(tmp_path: Path) -> None:
    marks = read_marks(write(tmp_path, HEADER + 'mast,960.25,540,957.05,-3e0\n\n "hill, west", 1,2,3,4\n'))
    assert marks.names == ("mast", "hill, west")
    assert marks.left.tolist() == [[960.25, 540.0], [1.0, 2.0]]
    assert marks.right.tolist() == [[957.05, -3.0], [3.0, 4.0]]


def test_columns_in_any_order_without_names_with_notes(tmp_path: Path) -> None:
    text = "note,right_v,right_u,left_v,left_u\nseen at dusk,4,3,2,1\n,8,7,6,5\n"
    marks = read_marks(write(tmp_path, text))
    assert marks.names == ("1", "2")
    assert marks.left.tolist() == [[1.0, 2.0], [5.0, 6.0]]
    assert marks.right.tolist() == [[3.0, 4.0], [7.0, 8.0]]


def test_spreadsheet_files_with_a_byte_order_mark(tmp_path: Path) -> None:
    marks = read_marks(write(tmp_path, b"\xef\xbb\xbf" + HEADER.encode() + b"a,1,2,3,4\r\n"))
    assert marks.names == ("a",)


ROW = "a,1,2,3,4\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty"),
        ("\n\n", "the file is empty"),
        (HEADER, "no rows under the header"),
        ("name,left_u,left_y,right_u,right_v\n" + ROW, "line 1: unknown column 'left_y'; did you mean 'left_v'"),
        ("name,Left_U,left_v,right_u,right_v\n" + ROW, "did you mean 'left_u'"),
        ("name,u_left,v_left,u_right,v_right\n" + ROW, "'u_left'; did you mean 'left_u'"),
        ("name,left_u,left_v,right_u,right_v,temperature\n" + ROW, "unknown column 'temperature'; the header is"),
        ("name,left_u,left_v,right_u\na,1,2,3\n", "line 1: the column 'right_v' is missing"),
        ("name,left_u,left_u,right_u,right_v\n" + ROW, "'left_u' is there twice"),
        (ROW, "line 1: unknown column 'a'"),
        ("name;left_u;left_v;right_u;right_v\na;1,5;2;3;4\n", "line 1: fields are separated by semicolons"),
        ("name\tleft_u\tleft_v\tright_u\tright_v\n", "line 1: fields are separated by tabs"),
        (HEADER + ROW + "b,1,2,3,4,5\n", "line 3: 6 fields"),
        (HEADER + ROW + "\nb,1,,3,4\n", "line 4: left_v is empty"),
        (HEADER + ROW + "b,1,2,inf,4\n", "line 3: right_u is 'inf'"),
        (HEADER.encode("utf-16"), "not UTF-8"),
    ],
)
def test_bad_files_name_the_line_and_the_remedy(tmp_path: Path, text: str | bytes, message: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(FileError, match=message) as caught:
        read_marks(path)
    assert str(path) in str(caught.value)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"nothing\.csv: cannot read"):
        read_marks(tmp_path / "nothing.csv")


class TestCovariance:
    COLUMNS = ",".join(f"cov_{i}{j}" for i in range(4) for j in range(i, 4))

    def test_round_trip(self, tmp_path: Path) -> None:
        root = torch.rand(2, 4, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        covariance = root @ root.mT + 0.1 * torch.eye(4).double()
        covariance[1] = torch.nan
        pixels = torch.rand(2, 2).double()
        marks = Marks.of_pair(("hill, west", "b"), pixels, pixels + 1.0, covariance)
        again = read_marks(write_marks(tmp_path / "marks.csv", marks))
        assert again.names == marks.names
        assert again.covariance is not None
        torch.testing.assert_close(again.covariance, covariance, equal_nan=True, atol=0, rtol=0)
        assert torch.equal(again.covariance_or(0.5)[1], 0.25 * torch.eye(4).double())

    @pytest.mark.parametrize(
        ("cells", "message"),
        [
            ("1,0,0,0,1,0,0,1,0,", "line 2: cov_33 is empty"),
            ("1,2,0,0,1,0,0,1,0,1", "line 2: the covariance is not positive definite"),
            ("1,0,0,0,1,0,0,1,0,x", "cov_33 is 'x'; a covariance in px² is needed"),
        ],
    )
    def test_bad_covariances(self, tmp_path: Path, cells: str, message: str) -> None:
        path = write(tmp_path, f"name,left_u,left_v,right_u,right_v,{self.COLUMNS}\na,1,2,3,4,{cells}\n")
        with pytest.raises(FileError, match=message):
            read_marks(path)

    def test_all_ten_columns_are_needed(self, tmp_path: Path) -> None:
        path = write(tmp_path, "name,left_u,left_v,right_u,right_v,cov_00\na,1,2,3,4,1\n")
        with pytest.raises(FileError, match="the column cov_01 is missing; a covariance needs all ten"):
            read_marks(path)


NONE = [math.nan, math.nan]


def marks(covariance: torch.Tensor | None) -> Marks:
    left = torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]], dtype=torch.float64)
    right = torch.tensor([[1.0, 2.0], NONE, [5.0, 6.0]], dtype=torch.float64)
    return Marks.of_pair(("a", "b", "c"), left, right, covariance)


def stated() -> torch.Tensor:
    found = torch.full((3, 4, 4), torch.nan, dtype=torch.float64)
    found[0] = torch.diag(torch.tensor([0.04, 0.12, 1e-6, 1e-6]).double())
    return found


def test_a_mark_has_the_mean_variance_of_its_axes() -> None:
    found = marks(stated()).sigmas(0.3)
    # No mark is better than a twentieth of a pixel.
    assert found[0].tolist() == pytest.approx([math.sqrt(0.08), 0.05])
    assert found[1].tolist() == pytest.approx([0.3, math.nan], nan_ok=True)
    assert found[2].tolist() == pytest.approx([0.3, 0.3])
    assert marks(None).sigmas(0.3).tolist()[0] == pytest.approx([0.3, 0.3])


def test_the_typical_sigma_is_the_median_of_the_marks_that_are_there() -> None:
    vague = torch.full((3, 4, 4), torch.nan, dtype=torch.float64)
    vague[0] = torch.diag(torch.tensor([9.0, 9.0, 4.0, 4.0]).double())
    assert marks(vague).typical_sigma(0.3) == 0.3
    assert marks(stated()).typical_sigma(0.1) == pytest.approx(0.1)
    assert marks(stated()).typical_sigma(0.01) == pytest.approx(0.01)
    assert Marks.of_pair(("a",), torch.tensor([NONE]), torch.tensor([NONE]), None).typical_sigma(0.3) == 0.3


def test_covariances_are_filled_pair_by_pair() -> None:
    assert marks(None).covariance_or(0.3) is None
    found = marks(stated()).covariance_or(0.3)
    assert torch.equal(found[0], stated()[0])
    torch.testing.assert_close(found[1], 0.09 * torch.eye(4, dtype=torch.float64))
    half = stated()
    half[0, 0, 1] = torch.nan
    found = marks(half).covariance_or(0.3)
    torch.testing.assert_close(found[0], 0.09 * torch.eye(4, dtype=torch.float64))
