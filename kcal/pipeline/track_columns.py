"""Tracks as the columns that files and maps of positions are made of."""

from __future__ import annotations

import numpy as np
import torch

from kcal.locate.cep import circular_error
from kcal.locate.columns import NUMBERS, PositionColumns
from kcal.locate.geodesy import azimuth_elevation
from kcal.locate.stereo import PositionStatus
from kcal.pipeline.tracks import Tracks

_REASONS = {
    int(PositionStatus.OK): "",
    int(PositionStatus.BEARING_ONLY): "the parallax is below three sigma: only the bearing is known",
    int(PositionStatus.PARALLEL): "the lines of sight do not meet: only the bearing is known",
}


def track_columns(tracks: Tracks, sequence: int) -> PositionColumns:
    """One row for each track; velocities, hits and times are further columns.

    Args:
        tracks: of one moment.
        sequence: number of the moment, which together with the name is never used twice.
    """
    state = tracks.state
    ok = state.status == int(PositionStatus.OK)
    count = len(tracks.number)
    table = np.full((len(NUMBERS), count), np.nan)
    circles = torch.full((count, 2), torch.nan, dtype=torch.float64)
    circles[ok] = circular_error(state.enu[ok], state.covariance[ok])
    covariance = state.covariance[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    everywhere = torch.ones_like(ok)
    for first, where, values in (
        ("lat", ok, state.geodetic.T),
        ("east_m", ok, state.enu.T),
        ("range_m", ok, 1.0 / torch.where(ok, state.inverse_range, 1.0)[None]),
        ("range_low_m", torch.isfinite(state.range_low), torch.stack([state.range_low, state.range_high])),
        ("cov_ee_m2", ok, covariance.T),
        ("cep50_m", ok, circles.T),
        ("azimuth_deg", everywhere, azimuth_elevation(state.bearing).T),
    ):
        row = NUMBERS.index(first)
        np.copyto(table[row : row + len(values)], values.cpu().numpy(), where=where.cpu().numpy())
    velocity = [_texts(state.velocity[:, i], ok) for i in range(3)]
    sigma = state.velocity_covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
    extras = {
        "sequence": [str(sequence)] * count,
        "time_s": [repr(tracks.time)] * count,
        "category": list(tracks.category),
        "hits": [str(hits) for hits in tracks.hits.tolist()],
        "unseen_s": [f"{seconds:.3f}" for seconds in tracks.unseen_s.tolist()],
        "velocity_east_mps": velocity[0],
        "velocity_north_mps": velocity[1],
        "velocity_up_mps": velocity[2],
        "velocity_east_sigma_mps": _texts(sigma[:, 0], ok),
        "velocity_north_sigma_mps": _texts(sigma[:, 1], ok),
        "velocity_up_sigma_mps": _texts(sigma[:, 2], ok),
    }
    status = state.status.cpu().numpy()
    names = [f"track {number}" for number in tracks.number]
    return PositionColumns(
        names, status, [_REASONS[int(code)] for code in status], np.ascontiguousarray(table.T), extras
    )


def _texts(values: torch.Tensor, ok: torch.Tensor) -> list[str]:
    return [repr(value) if there else "" for value, there in zip(values.tolist(), ok.tolist(), strict=True)]
