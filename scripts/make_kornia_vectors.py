"""Write the vectors with which kornia's camera models can be tested: points, pixels and derivatives by kcal.

    python -m scripts.make_kornia_vectors

They go to tests/kornia_conformance/vectors.json. The test beside it needs torch, kornia and pytest alone, so that
kornia can take both files as they are. `tests/lens/test_kornia.py` checks that kcal still computes these values, and
`cv2.projectPoints` agrees with the pixels.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch

from kcal import Camera
from kcal.files import write_atomic
from kcal.lens.projection import project_components

PATH = Path(__file__).parents[1] / "tests" / "kornia_conformance" / "vectors.json"
# kcal's lens, kornia's type of camera, and coefficients in kornia's order.
LENSES = {
    "PINHOLE": ("pinhole", []),
    "BROWN_CONRADY": ("opencv8", [-0.21, 0.06, 1.1e-3, -6e-4, 0.012, 0.023, 0.011, 0.0031]),
    "KANNALA_BRANDT_K3": ("fisheye4", [0.021, -0.011, 0.0032, -0.00052]),
}
CORE, SIZE = (801.5, 799.25, 321.75, 238.5), (640, 480)
# Along the axis, near it, in the corners, far and near.
POINTS = [[0.0, 0.0, 1.0], [1e-9, -1e-9, 1.0], [0.1, -0.2, 1.1], [-0.3, 0.2, 1.3], [0.4, 0.3, 2.5], [-0.39, -0.29, 1.0],
          [38.0, -29.0, 100.0], [3e-3, 2e-3, 0.01]]  # fmt: skip


def vectors() -> dict[str, Any]:
    """What the file contains."""
    points = torch.tensor(POINTS, dtype=torch.float64)
    cameras = []
    for kind, (model, lens) in LENSES.items():
        camera = Camera.build(focal=CORE[:2], center=CORE[2:], size=SIZE, coefficients=lens, model=model)
        chosen = [index for index, name in enumerate(camera.names) if name != "skew"]
        seen = project_components(points.T, camera.params, camera.model, chosen)
        cameras.append({
            "type": kind,
            "size": list(SIZE),
            "params": camera.params[chosen].tolist(),
            "points": POINTS,
            "pixels": seen.pixels.T.tolist(),
            "pixels_by_point": seen.by_point.permute(2, 1, 0).tolist(),
            "pixels_by_params": seen.by_camera.permute(2, 1, 0).tolist(),
        })  # fmt: skip
    about = "Integer pixels are centers; params: fx, fy, cx, cy, then the lens in kornia's order. Made by kcal."
    return {"about": about, "cameras": cameras}


if __name__ == "__main__":
    print(write_atomic(PATH, json.dumps(vectors(), indent=1) + "\n"))
