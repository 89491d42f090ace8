"""Leave out marks and corners at which a lens model has no ray."""

from __future__ import annotations

import dataclasses

import torch

from kcal.calibrate.rig.blocks import KINDS
from kcal.calibrate.rig.board_consensus import MINIMUM_CORNERS
from kcal.calibrate.rig.sources import RigData
from kcal.errors import InputError


def without_rayless(data: RigData) -> tuple[RigData, list[str]]:
    """The data with pixels at which a lens model has no ray taken as unseen, and warnings that count them.

    Raises:
        InputError: most corners of a board are such pixels.
    """
    warnings, changed = [], {}
    for kind in KINDS:
        source = getattr(data, kind)
        if source is None:
            continue
        pixels = source.pixels.clone()
        for c, camera in enumerate(data.cameras):
            seen = torch.isfinite(pixels[:, c]).all(-1)
            _, valid = camera.unproject(pixels[:, c])
            lost = seen & ~valid
            if not bool(lost.any()):
                continue
            if kind == "boards":
                few = (seen.sum(-1) >= MINIMUM_CORNERS) & ((seen & valid).sum(-1) < MINIMUM_CORNERS)
                for i in few.nonzero()[:, 0].tolist():
                    raise InputError(
                        f"board {source.names[i]}: the {data.names[c]} camera's lens model has no ray at most of its "
                        "corners: it folds inside the image; calibrate with views nearer the image's border or with a "
                        "smaller model"
                    )
            warnings.append(f"{int(lost.sum())} pixels of {kind} left out where {data.names[c]}'s lens has no ray")
            pixels[:, c] = torch.where(lost[..., None], torch.nan, pixels[:, c])
        changed[kind] = dataclasses.replace(source, pixels=pixels)
    return dataclasses.replace(data, **changed), warnings
