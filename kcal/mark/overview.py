"""The map of a marking session: cameras, landmarks and targets with their 95 % regions, as latitudes and longitudes."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from kcal.lens.mounting import Origin
from kcal.lens.rig import StereoRig
from kcal.locate.geodesy import enu_from_cam, enu_to_geodetic
from kcal.locate.positions import Located
from kcal.locate.region import near, region_rings
from kcal.locate.survey import Survey

_NOWHERE = Origin(lat=0.0, lon=0.0, height=0.0)


def map_content(rig: StereoRig, located: Located | None, survey: Survey | None, *, anchored: bool) -> dict[str, Any]:
    """What the page draws with Leaflet.

    Args:
        rig: in use; without a mounting it stands at latitude and longitude 0 and looks north.
        located: positions of the targets.
        survey: the landmarks.
        anchored: whether latitudes mean anything; otherwise the page shows meters only.
    """
    origin, turn = _NOWHERE, enu_from_cam(0.0)
    if rig.mounting is not None:
        stands = rig.mounting
        origin, turn = stands.origin, enu_from_cam(stands.heading_deg, stands.pitch_deg, stands.roll_deg)

    def places(enu: Tensor, around: Origin) -> list[tuple[float, float]]:
        return [(lat, near(lon, origin.lon)) for lat, lon, _ in enu_to_geodetic(enu, around).tolist()]

    right = -rig.right_from_left_rotation.T @ rig.right_from_left_translation
    centers = torch.stack([torch.zeros_like(right), right]) @ turn.T
    frame = _NOWHERE if survey is None or survey.origin is None else survey.origin
    rings = iter([] if located is None else region_rings(located))
    targets = []
    for position in () if located is None else located.positions:
        if position.azimuth_deg is None:
            continue
        angle = math.radians(position.azimuth_deg)
        ends = [value or 0.0 for value in (position.range_low_m, position.range_high_m)]
        far = min(ends[1], 3 * (position.range_m or ends[0])) if math.isfinite(ends[1]) else 3 * max(ends[0], 100.0)
        line = torch.tensor([[math.sin(angle), math.cos(angle), 0.0]]).double() * torch.tensor([[ends[0]], [far]])
        spot = None if position.lat is None or position.lon is None else (position.lat, near(position.lon, origin.lon))
        targets.append({"name": position.name, "place": spot, "line": places(line, origin),
                        "ring": None if position.lat is None else next(rings)})  # fmt: skip
    # Landmarks in a frame of their own cannot be drawn with a rig that stands nowhere.
    drawn = survey is not None and rig.mounting is not None
    return {
        "refusal": "",
        "anchored": anchored,
        "cameras": [{"name": n, "place": p} for n, p in zip(("left", "right"), places(centers, origin), strict=True)],
        "landmarks": [
            {"name": name, "place": place}
            for name, place in zip(survey.names, places(survey.points, frame), strict=True)
        ] if survey is not None and drawn else [],
        "targets": targets,
    }  # fmt: skip
