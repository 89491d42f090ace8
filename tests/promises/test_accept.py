"""The table of cases that can be read without Python, `accept.txt`: each holds in both directions."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from kcal.lens.camera import Camera
from kcal.lens.model import LensModel

TABLE = Path(__file__).with_name("accept.txt")


def cells() -> Iterator[tuple[int, list[str]]]:
    for number, text in enumerate(TABLE.read_text(encoding="utf-8").splitlines(), 1):
        if text and not text.startswith("#"):
            yield number, [cell.strip() for cell in text.split(" |")]


def camera_of(kind: str, coefficients: str) -> Camera:
    model_name, size, intrinsics = kind.split(", ")
    model = LensModel.named(model_name)
    given = {name: float(value) for name, value in (word.split("=") for word in coefficients.split())}
    assert given.keys() <= set(model.names)
    fx, fy, cx, cy = map(float, intrinsics.split())
    width, height = map(int, size.split(" x "))
    return Camera.build(
        focal=(fx, fy),
        center=(cx, cy),
        size=(width, height),
        model=model,
        coefficients=[given.get(name, 0.0) for name in model.names],
    )


CAMERAS = {
    row[0].removeprefix("camera "): camera_of(row[1], row[2]) for _, row in cells() if row[0].startswith("camera ")
}
LINES = [(number, row) for number, row in cells() if not row[0].startswith("camera ")]


def failures(lines: list[tuple[int, list[str]]]) -> list[str]:
    """The lines that do not hold, with how far they are off."""
    out = []
    for number, (name, pixel_text, ray_text, tolerance_text, _) in lines:
        pixel, ray = (
            torch.tensor([[float(word) for word in text.split()]], dtype=torch.float64)
            for text in (pixel_text, ray_text)
        )
        camera, tolerance = CAMERAS[name], float(tolerance_text)
        forward = float((camera.project(ray)[0] - pixel).norm())
        # In pixels too: the length of a ray is free.
        back = float((camera.project(camera.unproject(pixel)[0])[0] - pixel).norm())
        turned = camera.unproject(pixel)[0]
        angle = float(torch.linalg.cross(turned, ray).norm() / (turned.norm() * ray.norm()))
        sideways = angle * float(camera.focal.max())
        same_side = float((turned * ray).sum()) > 0
        if not (forward <= tolerance and back <= tolerance and sideways <= 10 * tolerance and same_side):
            out.append(f"line {number}, {name}: off by {forward:.1e}, {back:.1e} and {sideways:.1e} px")
    return out


@pytest.mark.parametrize("name", CAMERAS)
def test_lines(name: str) -> None:
    lines = [(number, row) for number, row in LINES if row[0] == name]
    assert lines
    assert failures(lines) == []


def test_a_wrong_line_is_found() -> None:
    number, row = LINES[0]
    assert failures([(number, [row[0], "500.001 400", *row[2:]])]) != []
    assert failures([(number, [row[0], row[1], "0 0 -1", *row[3:]])]) != []


def test_there_are_hundreds_from_several_sources() -> None:
    sources = [row[4].split()[0] for _, row in LINES]
    assert len(LINES) >= 200
    assert min(sources.count(source) for source in ("OpenCV", "mrcal", "Eq.")) >= 20
