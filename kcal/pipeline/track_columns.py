"""Tracks as the columns that files and maps of positions are made of."""

from __future__ import annotations

import torch

from kcal.lens.camera_rig import CameraRig
from kcal.locate.localizer import Localization
from kcal.locate.station_positions import own_axes
from kcal.locate.stereo import PositionStatus
from kcal.locate.tables import PositionColumns
from kcal.locate.tabulate import number_table
from kcal.pipeline.estimates import TrackStates
from kcal.pipeline.track_options import Tracks

_REASONS = {
    int(PositionStatus.OK): "",
    int(PositionStatus.BEARING_ONLY): "the parallax is below three sigma: only the bearing is known",
    int(PositionStatus.PARALLEL): "the lines of sight do not meet: only the bearing is known",
}


def track_columns(tracks: Tracks, sequence: int, stations: CameraRig | None = None) -> PositionColumns:
    """One row for each track; velocities, hits and times are further columns.

    Args:
        tracks: of one moment.
        sequence: number of the moment, which together with the name is never used twice.
        stations: cameras far apart: bearings are then those at the anchor's own vertical, and two more columns tell
            from which camera a track is told, and which see it now.
    """
    state = TrackStates(*(value.cpu() for value in tracks.state))
    ok = state.status == int(PositionStatus.OK)
    count = len(tracks.number)
    if stations is not None:
        state = state._replace(bearing=(own_axes(stations).cpu()[state.anchor] @ state.bearing[..., None])[..., 0])
    shared = {name: value for name, value in state._asdict().items() if name in Localization._fields}
    numbers = number_table(Localization(**shared, reprojection=torch.zeros(count, 2)))
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
    if stations is not None:
        extras["told_from"] = [stations.names[camera] for camera in state.anchor.tolist()]
        extras["cameras"] = [
            " ".join(name for name, one in zip(stations.names, row, strict=True) if one) for row in tracks.seen.tolist()
        ]
    names, status = [f"track {number}" for number in tracks.number], state.status.numpy()
    return PositionColumns(names, status, [_REASONS[int(code)] for code in status], numbers, extras)


def _texts(values: torch.Tensor, ok: torch.Tensor) -> list[str]:
    return [repr(value) if there else "" for value, there in zip(values.tolist(), ok.tolist(), strict=True)]
