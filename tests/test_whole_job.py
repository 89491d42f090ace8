"""The job of the README in Python, from images to positions, with the names of `kcal` alone."""

import json
from pathlib import Path

import cv2
import pytest
import torch
from board_render import render
from command_line import rows_of
from locate_rigs import located_pairs
from torch import Tensor

import kcal

BOARD = kcal.Board(columns=7, rows=6, square=0.05)
SIZE = (640, 480)
CAMERA = kcal.Camera.build(focal=(700, 702), center=(321, 238), size=SIZE, model="pinhole")
TRUTH = kcal.Rig.pair(CAMERA, CAMERA, torch.eye(3), torch.tensor([-0.25, 0.0, 0.0]))
ORIGIN = kcal.Origin(lat=19.07, lon=72.87, height=14.0)
TARGETS = torch.tensor([[0.4, 0.1, 6.0], [-1.0, -0.3, 12.0]], dtype=torch.float64)


def turned(tilt: Tensor) -> Tensor:
    x, y, z = tilt.tolist()
    return torch.linalg.matrix_exp(torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64))


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Boards seen by both cameras at once, as PNG files left-0.png, right-0.png, ..."""
    folder = tmp_path_factory.mktemp("images")
    K = CAMERA.matrix.detach()
    squares = torch.diag(torch.tensor([BOARD.square, BOARD.square, 1.0], dtype=torch.float64))
    middle = torch.tensor([-0.15, -0.125, 0.0], dtype=torch.float64)
    for i in range(6):
        angle = torch.tensor(0.8 * i, dtype=torch.float64)
        rotation = turned(torch.stack([0.5 * angle.cos(), 0.5 * angle.sin(), 0.1 * angle.sin()]))
        shift = rotation @ middle + torch.tensor([0.125 + 0.04 * (i % 3 - 1), 0.05 * (i % 2) - 0.02, 0.8])
        for side, offset in (("left", 0.0), ("right", -0.25)):
            at = shift + torch.tensor([offset, 0.0, 0.0], dtype=torch.float64)
            pixel_from_squares = K @ torch.stack([rotation[:, 0], rotation[:, 1], at], -1) @ squares
            image, _ = render(BOARD, SIZE, pixel_from_squares.numpy(), supersample=3, seed=i)
            assert cv2.imwrite(str(folder / f"{side}-{i}.png"), image)
    return folder


@pytest.mark.slow
def test_from_images_to_positions(images: Path, tmp_path: Path) -> None:
    # Images to corners.
    seen = {}
    for side in ("left", "right"):
        found = kcal.detect(sorted(images.glob(f"{side}-*.png")), BOARD)
        assert len(found.views) == 6
        seen[side] = kcal.Observations.load(found.save(tmp_path / f"{side}.obs.json"))

    # Corners to cameras, with their error bars in the file.
    cameras = {}
    for side, views in seen.items():
        result = kcal.calibrate_camera(views, kcal.CalibrationOptions(model="pinhole"))
        assert result.rms < 0.1
        file = kcal.save_camera(result.camera, tmp_path / f"{side}.json", name=side)
        cameras[side] = kcal.load_camera(file)
        known = cameras[side].calibration
        assert known is not None
        assert (known.name, known.sigma) == (side, {name: result.sigma.get(name) for name in result.camera.names})
        assert known.record is not None
        assert known.record.rms == result.rms
        assert known.covariance is not None
        torch.testing.assert_close(known.covariance, result.covariance, rtol=1e-6, atol=1e-12)
        spread = kcal.lens.pixel_covariance(cameras[side], torch.tensor([[0.0, 0.0, 5.0]], dtype=torch.float64))
        assert 0 < float(spread[0].diagonal().sqrt().max()) < 1.0

    # Cameras to a rig; where it stands is measured.
    pairs = kcal.rig.pair_by_name(seen["left"].names, seen["right"].names)
    rig = kcal.calibrate_rig(cameras["left"], cameras["right"], seen["left"], seen["right"], pairs).stereo()
    rig.mounting = kcal.rig.Mounting(
        origin=ORIGIN, heading_deg=35.0, covariance=kcal.rig.mounting_covariance(origin_m=[0.02] * 3)
    )
    assert float(rig.baseline) == pytest.approx(0.25, rel=2e-3)
    file = kcal.save_rig(rig, tmp_path / "rig.json")

    # A rig and pixels to positions, in a detector's graph and as a list.
    left, right = TRUTH(TARGETS)[0].unbind(-2)
    localize = kcal.Localizer.from_file(file, pixel_sigma=0.1)
    found = localize(left, right)
    assert localize.included == ("marks", "calibration", "mounting")
    assert [kcal.PositionStatus(int(code)).name for code in found.status] == ["OK", "OK"]
    true = torch.linalg.vector_norm(TARGETS, dim=-1)
    assert ((found.range_low < true) & (true < found.range_high)).all()
    located = located_pairs(kcal.load_rig(file), left, right, pixel_sigma=0.1, names=["gate", "mast"])
    assert located.included == localize.included
    for position, low in zip(located.positions, found.range_low.tolist(), strict=True):
        assert position.range_low_m == pytest.approx(low, rel=1e-12)

    # Positions to files.
    truth = TARGETS @ kcal.locate.enu_from_cam(35.0).T
    for name in ("positions.csv", "positions.geojson", "positions.kml", "positions.cot"):
        kcal.locate.write_positions(tmp_path / name, located)
    kcal.report.save_map(tmp_path / "map.html", located, truth)
    assert [row["name"] for row in rows_of(tmp_path / "positions.csv")] == ["gate", "mast"]
    features = json.loads((tmp_path / "positions.geojson").read_text())["features"]
    place = kcal.locate.enu_to_geodetic(truth[:1], ORIGIN)[0].tolist()
    gate = next(item for item in features if item["properties"].get("name") == "gate")
    assert gate["geometry"]["coordinates"][:2] == pytest.approx([place[1], place[0]], abs=2e-6)
