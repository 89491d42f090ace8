"""The truth of a practice site as plain numbers, which results are compared with later without the simulator."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from kcal.sim.practice import SIDES, PracticeSite, Side
from kcal.sim.practice_film import RATE, ships_at
from kcal.sim.truth import TruthLens

DISTANCES = (1000.0, 2000.0, 5000.0)
_GRID, _COARSE = (33, 19), (11, 5)


def practice_truth(site: PracticeSite, frames: int) -> dict[str, Any]:
    """What `kcal.report.practice_score` compares with.

    Args:
        site: the coast.
        frames: of the film.
    """
    scene, rig = site.scene, site.scene.rig
    things = {**_places_by_name(scene.landmarks), **_places_by_name(scene.targets)}
    pixels = {side: site.true_pixels(side, np.array([*things.values()])) for side in SIDES}
    return {
        "kcal": "practice truth",
        "version": 1,
        "seed": scene.seed,
        "origin": {"lat": scene.lat, "lon": scene.lon, "height": scene.height},
        "heading_deg": scene.heading_deg,
        "cameras": {side: _lens_record(getattr(rig, side)) for side in SIDES},
        "baseline_m": float(rig.baseline),
        "pairs": [_pairs_record(site, distance) for distance in DISTANCES],
        "landmarks": _places_by_name(scene.landmarks),
        "targets": _places_by_name(scene.targets),
        "marks": {
            name: [*pixels["left"][row].tolist(), *pixels["right"][row].tolist()] for row, name in enumerate(things)
        },
        "ships": {
            "times": [number / RATE for number in range(frames)],
            "places": _ship_places(site, frames),
        },
    }


def ship_boxes(site: PracticeSite, side: Side, frames: int) -> NDArray[np.float64]:
    """Middles of the boxes around the ships in the images of one camera: (frames, ships, 2) pixels, nearest last."""
    camera = site.eyes[side]
    ships = [each for number in range(frames) for each in ships_at(site, number / max(frames - 1, 1))]
    points = np.stack([site.coast.apparent(each.middle) for each in ships])
    return camera.project(points)[0].reshape(frames, -1, 2)


def _places_by_name(points: Any) -> dict[str, list[float]]:
    return dict(zip(points.names, points.enu.tolist(), strict=True))


def _lens_record(lens: TruthLens) -> dict[str, Any]:
    x, y = (np.linspace(0.0, size - 1.0, count) for size, count in zip(lens.size, _GRID, strict=True))
    pixels = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    rays, _ = lens.unproject(torch.from_numpy(pixels))
    return {"size": list(lens.size), "pixels": pixels.tolist(), "rays": rays.tolist()}


def _pairs_record(site: PracticeSite, distance: float) -> dict[str, Any]:
    """Exact marks, over the image, of points at a distance."""
    rig = site.scene.rig
    width, height = rig.left.size
    x, y = np.linspace(0.03 * width, 0.97 * width, _COARSE[0]), np.linspace(0.1 * height, 0.9 * height, _COARSE[1])
    rays, _ = rig.left.unproject(torch.from_numpy(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)))
    left, right, valid = rig(distance * rays)
    seen = valid & rig.left.inside(left) & rig.right.inside(right)
    return {"range_m": distance, "left": left[seen].tolist(), "right": right[seen].tolist()}


def _ship_places(site: PracticeSite, frames: int) -> dict[str, list[list[float]]]:
    places: dict[str, list[list[float]]] = {}
    for number in range(frames):
        for each in ships_at(site, number / max(frames - 1, 1)):
            places.setdefault(each.passage.name, []).append(each.middle.tolist())
    return places
