"""Write one file of every kind with the kcal that is imported, and what this version computes from each.

    PYTHONPATH=TREE_OF_THE_VERSION python tests/promises/make_files.py tests/promises/files/VERSION

Run once for each version that was published or that others had files of, with that version's own code, and never
again: `tests/promises/test_files.py` reads the files with the present code and compares. It uses only what every
version has.
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch

import kcal
from kcal import Board, CalibrationOptions, Camera, Observations, View, calibrate_camera, load_camera, save_camera
from kcal.calibrate import load_measured_board, save_measured_board
from kcal.io.rig_file import load_rig, save_rig
from kcal.lens import bake, load_lookup, rotation_from_vector, save_lookup
from kcal.lens.rig import Origin, Rig

SIZE = (640, 480)
MODELS = ("hybrid", "opencv5", "opencv14", "fisheye4")
# Points in front of the camera, meters, near ones too: an entrance pupil that moves shows there.
POINTS = [[x, y, z] for z in (0.4, 1.0, 500.0) for x, y in ((0.0, 0.0), (0.3 * z, 0.2 * z), (-0.25 * z, 0.15 * z))]
PIXELS = [[u, v] for v in (20.0, 240.0, 455.5) for u in (15.0, 320.0, 600.25)]


def observed() -> Observations:
    """Twelve views of a board with 0.1 px of noise."""
    noise = np.random.default_rng(7)
    camera = Camera.build(focal=(520, 521), center=(322, 238), size=SIZE, coefficients=[-0.2, 0.05])
    board = Board(columns=8, rows=6, square=0.03)
    views = []
    for i in range(12):
        tilt = torch.tensor([0.5 * np.sin(i), 0.5 * np.cos(i), 0.1 * i], dtype=torch.float64)
        middle = board.points.mean(0)
        place = torch.tensor([0.05 * np.cos(2 * i), 0.04 * np.sin(3 * i), 0.45 + 0.02 * (i % 4)], dtype=torch.float64)
        points = (board.points - middle) @ rotation_from_vector(tilt).T + place
        pixels = camera.project(points)[0].numpy() + noise.normal(0.0, 0.1, (len(points), 2))
        views.append(View(name=f"view{i:02d}.png", pixels=[tuple(map(float, pixel)) for pixel in pixels]))
    return Observations(board=board, image_size=SIZE, views=tuple(views))


def computed(camera: Camera) -> dict[str, object]:
    """Numbers that must not change."""
    return {
        "pixels": camera.project(torch.tensor(POINTS, dtype=torch.float64))[0].tolist(),
        "rays": camera.unproject(torch.tensor(PIXELS, dtype=torch.float64))[0].tolist(),
        "params": camera.params.tolist(),
    }


def camera_rig(folder: Path, out: dict[str, object]) -> None:
    """A rig of three cameras with error bars."""
    lens = {"opencv5": [-0.2, 0.05, 1e-3, -5e-4, 0.01], "fisheye4": [0.02, -0.003], "pinhole": []}
    cameras = [
        Camera.build(focal=(520 + i, 521), center=(322, 238), size=SIZE, coefficients=values, model=model)
        for i, (model, values) in enumerate(lens.items())
    ]
    north = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    turns = rotation_from_vector(torch.tensor([[0.0, 0, 0], [0, 0.3, 0], [0.02, -0.2, 0.01]], dtype=torch.float64))
    centers = torch.tensor([[0.0, 0, 0], [12_000.5, 300, 45], [-8_000, 9_000.25, 120]], dtype=torch.float64)
    site = Origin(lat=19.07, lon=72.87, height=14.0)
    rig = Rig(cameras, [*lens], turns @ north, center=centers, origin=site, refraction=0.14)
    rig.root = rig.with_errors(position_m=(0.02, 0.02, 0.05), attitude_deg=0.01, refraction=0.05)
    save_rig(rig, folder / "camera-rig.json")
    out["camera-rig.json"] = {
        "rotation": rig.rotation.tolist(),
        "center": rig.center.tolist(),
        "variance": rig.root.square().sum(0).tolist(),
        "cameras": [computed(camera) for camera in cameras],
    }


def main(folder: Path) -> None:
    """Files and `computed.json`."""
    folder.mkdir(parents=True, exist_ok=True)
    out: dict[str, object] = {"version": kcal.__version__, "points": POINTS, "marks": PIXELS}
    seen = observed()
    seen.save(folder / "observations.json")
    out["observations.json"] = {"sum": float(sum(sum(map(sum, view.pixels)) for view in seen.views))}
    cameras, boards = {}, {}
    for model in MODELS:
        found = calibrate_camera(seen, CalibrationOptions(model=model))
        name = f"{model}.camera.json"
        boards[model] = found.measured_board
        save_camera(found.camera, folder / name)
        cameras[model] = load_camera(folder / name)
        out[name] = computed(cameras[model])
    if boards.get("hybrid") is not None:
        save_measured_board(boards["hybrid"], folder / "board.json")
        out["board.json"] = {"points": load_measured_board(folder / "board.json").points.tolist()}
    turned = rotation_from_vector(torch.tensor([0.01, -0.02, 0.005], dtype=torch.float64))
    save_rig(
        Rig.pair(cameras["hybrid"], cameras["opencv14"], turned, torch.tensor([-10.0, 0.02, 0.1])), folder / "rig.json"
    )
    rig = load_rig(folder / "rig.json")
    out["rig.json"] = {
        "rotation": rig.right_from_left_rotation.tolist(),
        "translation": rig.right_from_left_translation.tolist(),
        "left": computed(rig.left),
        "right": computed(rig.right),
    }
    save_lookup(bake(cameras["opencv5"], 0.05), folder / "lookup.npz")
    pixels = load_lookup(folder / "lookup.npz").project(torch.tensor(POINTS[3:], dtype=torch.float64))[0]
    out["lookup.npz"] = {"pixels": pixels.tolist()}
    camera_rig(folder, out)
    (folder / "computed.json").write_text(json.dumps(out, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
