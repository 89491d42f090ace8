"""Compare positions with the truth where it is known."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.errors import InputError
from kcal.lens.mounting import Origin
from kcal.locate.localizer import StereoLocalizer
from kcal.locate.positions import Located
from kcal.locate.survey import read_survey


def read_truth(path: str | Path, located: Located) -> Tensor:
    r"""True positions (N, 3) east, north, up of the left camera for the located points by name; NaN where unknown.

    Args:
        path: a CSV with name,lat,lon,height or name,east,north,up (of the left camera), other columns as a survey has.
        located: what they are compared with.

    Raises:
        FileError: see `kcal.locate.survey.read_survey`.
        InputError: no name is in both.

    Example:
        >>> import tempfile
        >>> from kcal import locate_points
        >>> from kcal.rig import planned_rig
        >>> left, right, _ = planned_rig()(torch.tensor([[0.0, 0.0, 1000.0]]))
        >>> located = locate_points(planned_rig(), left, right, names=["mast"], heading_deg=0.0,
        ...                         origin=Origin(lat=19.07, lon=72.87, height=14.0))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(folder, "truth.csv").write_text("name,east,north,up\nmast,1,1000,0\n")
        ...     read_truth(Path(folder, "truth.csv"), located).tolist()
        [[1.0, 1000.0, 0.0]]
    """
    here = Origin(lat=located.origin.lat, lon=located.origin.lon, height=located.origin.height)
    survey = read_survey(path, here, measured=False)
    index = {name: i for i, name in enumerate(survey.names)}
    names = [position.name for position in located.positions]
    if not any(name in index for name in names):
        raise InputError(f"{path}: none of its names ({', '.join(survey.names[:3])} ...) is among the points")
    nowhere = torch.full((3,), math.nan, dtype=torch.float64)
    return torch.stack([survey.points[index[name]] if name in index else nowhere for name in names])


def position_errors(located: Located, truth: Tensor) -> list[tuple[float, float, bool] | None]:
    """The error of each position; None where position or truth is unknown.

    Returns:
        for each position its horizontal distance from the truth and its range minus the true one (meters), and whether
        the range interval contains the true range.

    Example:
        >>> from kcal import Camera, StereoRig, locate_points
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        >>> found = locate_points(rig, torch.tensor([[960.0, 540.0]]), torch.tensor([[944.0, 540.0]]),
        ...                origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0)
        >>> [round(value, 6) for value in position_errors(found, torch.tensor([[3.0, 996.0, 0.0]]).double())[0][:1]]
        [5.0]
    """
    truth = as_points("truth", truth, 3)
    if truth.ndim != 2 or len(truth) != len(located.positions):
        raise InputError(f"truth: shape ({len(located.positions)}, 3) is needed, got {tuple(truth.shape)}")
    out: list[tuple[float, float, bool] | None] = []
    for position, true in zip(located.positions, truth, strict=True):
        if position.enu is None or position.range_m is None or not bool(torch.isfinite(true).all()):
            out.append(None)
            continue
        east, north, _ = (torch.tensor(position.enu, dtype=torch.float64) - true).tolist()
        away = float(torch.linalg.vector_norm(true))
        low, high = position.range_low_m or 0.0, position.range_high_m or math.inf
        out.append((math.hypot(east, north), position.range_m - away, low <= away <= high))
    return out


@torch.no_grad()
def interval_coverage(localize: StereoLocalizer, left: Tensor, right: Tensor, ranges: Tensor) -> float:
    """The share of pairs whose 95 % range interval contains the true range.

    Args:
        localize: what locates them.
        left: (N, 2) marks in the left image.
        right: (N, 2) in the right one.
        ranges: (N,) true ranges, meters.

    Example:
        >>> from kcal.rig import planned_rig
        >>> points = torch.tensor([[0.0, 0.0, 500.0], [9.0, 0.0, 800.0], [0.0, 9.0, 900.0]]).double()
        >>> localize = StereoLocalizer(planned_rig(), origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0)
        >>> round(interval_coverage(localize, *planned_rig()(points)[:2], torch.tensor([500.0, 2000.0, 900.0])), 3)
        0.667
    """
    found = localize(left, right)
    return float(((found.range_low <= ranges) & (ranges <= found.range_high)).double().mean())
