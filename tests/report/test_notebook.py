"""What notebooks show: the command line's picture or table, complete and escaped, without jinja2."""

import base64
import copy
import io
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
import torch
from calibrate_scenes import motions, observe, pixels_of
from command_line import ran
from locate_rigs import located_pairs
from PIL import Image

import kcal
from kcal import Board, CalibrationOptions, Camera, Landmarks, Observations, Origin, Rig, RigData, RigOptions

ROOT = Path(__file__).parents[2]
NASTY = "<b>north & \x1b[2J$x^$"
CAMERA = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080), model="pinhole")
RIG = Rig.pair(CAMERA, CAMERA, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))


class Read(HTMLParser):
    """Tags, texts, cells and pictures."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: set[str] = set()
        self.text, self.rows, self.pictures = "", list[list[str]](), list[Any]()
        self.feed(html)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag == "img":
            data = str(dict(attrs)["src"]).removeprefix("data:image/png;base64,")
            self.pictures.append(Image.open(io.BytesIO(base64.b64decode(data))))
        elif tag != "br":
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data + "\n"
        if self.open and self.open[-1] in ("td", "th"):
            self.rows[-1][-1] += data


def read(value: Any) -> Read:
    html = value._repr_html_()
    found = Read(html)
    assert found.tags <= {"p", "br", "table", "tr", "td", "th", "img", "pre"}
    assert "\x1b" not in html
    assert str(ROOT) not in html
    return found


def observed(name: str = NASTY, blurred: bool = True) -> Observations:
    pixels = pixels_of(CAMERA, motions(CAMERA, 5, 4), noise=0.05)
    seen = observe(pixels, size=CAMERA.size, names=[f"{name} {number}" for number in range(5)])
    failures = [{"name": name, "reason": "blurred"}] if blurred else []
    return Observations(board=seen.board, image_size=CAMERA.size, views=seen.views, failures=failures)


@pytest.fixture(scope="module")
def calibrated() -> Any:
    return kcal.calibrate_camera(observed(), CalibrationOptions(model="opencv5"))


def test_a_camera_is_the_table_of_the_command_line(calibrated: Any, tmp_path: Path) -> None:
    found = read(calibrated.camera)
    printed = ran("show", kcal.save_camera(calibrated.camera, tmp_path / "c.camera.json")).output
    assert [line for line in found.text.splitlines() if line.strip() and line.strip() not in printed] == []
    names = ["fx", "fy", "cx", "cy", "skew", "k1", "k2", "p1", "p2", "k3"]
    assert [row[0] for row in found.rows] == ["parameter", *names]
    assert all(sigma for name, _, sigma in found.rows[1:] if name != "skew")


def test_cameras_that_no_table_shows_have_their_repr() -> None:
    assert Camera(CAMERA.params.expand(2, -1), size=CAMERA.size, model=CAMERA.model)._repr_html_() is None
    assert copy.deepcopy(CAMERA).to("meta")._repr_html_() is copy.deepcopy(RIG).to("meta")._repr_html_() is None
    learned = Camera.build(focal=(900, 900), center=(300, 300), size=(640, 480))
    learned.params.requires_grad_()
    assert "640x480" in read(learned).text


def test_rigs_of_two_cameras_and_of_many() -> None:
    rig = kcal.load_rig(ROOT / "assets" / "sample-rig.json")
    printed = ran("show", ROOT / "assets" / "sample-rig.json").output
    found = read(rig)
    lines = [line.strip() for line in found.text.splitlines() if line.strip()]
    assert len(lines) > 20
    assert [line for line in lines if line not in printed] == []
    look = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    places = torch.tensor([[0.0, 0, 0], [3000, 0, 0], [0, 3000, 0]])
    found = read(Rig([CAMERA] * 3, [NASTY, "b", "c"], look.repeat(3, 1, 1), center=places))
    assert found.rows[-3][0].startswith("<b>north & \\x1b[2J")
    assert "no error bars of the poses" in found.text


@pytest.mark.slow
def test_calibrations_and_observations_are_their_pictures(calibrated: Any) -> None:
    found = read(calibrated)
    assert [picture.size[0] > 1000 for picture in found.pictures] == [True]
    assert all(text in found.text for text in calibrated.warnings)
    seen = read(observed())
    assert len(seen.pictures) == 1
    assert "5 views with 210 corners, 1 image without" in seen.text
    assert "<b>north & \\x1b[2J$x^$: blurred" in seen.text
    empty = Observations(board=Board(columns=7, rows=6, square=0.05), image_size=(9, 9), views=())
    assert read(empty).pictures == []


def test_a_solved_rig_is_its_picture() -> None:
    ahead = 80.0 * (1.0 + torch.arange(8).double())
    places = torch.stack([ahead * torch.sin(ahead), ahead * torch.cos(ahead), 10 * ahead], -1) * 0.4
    pixels = torch.stack(RIG(places)[0].unbind(-2), 1)
    seen = Landmarks(names=(NASTY, *"bcdefgh"), points=places, sigma=torch.full_like(places, 0.02), pixels=pixels,
                     pixel_sigma=0.1)  # fmt: skip
    data = RigData(cameras=(CAMERA, CAMERA), names=("left", "right"), landmarks=seen)
    found = read(kcal.solve_rig(data, RigOptions(refraction=0.0, refraction_sigma=0.0)))
    assert len(found.pictures) == 1


def located(count: int) -> Any:
    left = torch.full((count, 2), 500.0) + torch.arange(count)[:, None]
    right = left - torch.tensor([3.2, 0.0])
    right[-1] += 10.0
    names = (NASTY, *map(str, range(1, count)))
    return located_pairs(RIG, left, right, names=names, origin=Origin(lat=1.0, lon=2.0, height=3.0), heading_deg=0.0)


def test_positions_are_a_picture_and_a_table() -> None:
    found = read(located(4))
    assert [len(found.pictures), len(found.rows)] == [1, 5]
    assert found.rows[0][:3] == ["name", "lat °", "lon °"]
    assert found.rows[1][0] == "<b>north & \\x1b[2J$x^$"
    assert "3 of 4 points located" in found.text
    assert "* 3: " in found.text


def test_of_many_positions_some_are_shown() -> None:
    found = read(located(500))
    assert len(found.rows) == 41
    assert "39 of 40 points located, a sample of the 500 in the table" in found.text


def test_jinja_is_not_needed(calibrated: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "jinja2", None)
    for value in (calibrated.camera, calibrated, observed(), located(2), RIG):
        assert read(value).open == []
