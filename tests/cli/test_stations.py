"""`kcal rig` of many cameras, `kcal station` and `kcal locate` of what they saw."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from kcal.io.camera_file import save_camera
from kcal.lens.camera import Camera
from kcal.locate.geodesy import enu_to_geodetic
from scripts.shared.station_scenes import ORIGIN, marks, ring, targets

NAMES = ("mill", "mast", "church", "hill")
SMOKE = torch.tensor([[300.0, 500, 200], [-900, -300, 180], [1200, -800, 150], [0, 0, -400]], dtype=torch.float64)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out, rig, generator = tmp_path_factory.mktemp("stations"), ring(4, 5000.0), torch.Generator().manual_seed(3)
    groups = [targets(8, generator, 800.0)]
    for center in rig.center:
        share = 0.1 + 0.6 * torch.rand(6, 1, dtype=torch.float64, generator=generator)
        groups.append(center + share * (targets(6, generator, 1500.0) - center) - torch.tensor([0.0, 0.0, 60.0]))
    points = torch.cat(groups)
    pixels = marks(rig, points) + 0.3 * torch.randn(len(points), 4, 2, dtype=torch.float64, generator=generator)
    places = enu_to_geodetic(points, ORIGIN).tolist()
    survey = [f"post {i},{a:.9f},{b:.9f},{c:.4f},0.05" for i, (a, b, c) in enumerate(places)]
    (out / "survey.csv").write_text("\n".join(["name,lat,lon,height,sigma", *survey]) + "\n")
    others = {"church", "hill"}
    lines = [line for line in (folder / "marks.csv").read_text().splitlines() if not others & {*line.split(",")}]
    (folder / "two.csv").write_text("\n".join(lines) + "\n")
    other = Camera.build(focal=(1600.001, 1600), center=(959.5, 539.5), size=(1920, 1080), model="pinhole")
    save_camera(other, folder / "mast.camera.json")
    run(
        folder, "rig", "mill.camera.json", "mast.camera.json", "--landmarks", "survey.csv", "--marks", "two.csv",
        "-o", "two.json",
    )  # fmt: skip
    assert json.loads((folder / "two.json").read_text())["version"] == 2
