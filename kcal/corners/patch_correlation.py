"""Normalized correlation of patches with places of another image, and its peaks."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

RIVAL_DISTANCE = 3.0  # pixels or steps from which two places count as different matches


@torch.no_grad()
def is_textured(template: Tensor, weight: Tensor) -> Tensor:
    """(N,) whether templates (N, h, w) are not flat where they count."""
    full = weight.sum((1, 2)).clamp_min(1e-12)
    level = (weight * template).sum((1, 2)) / full
    contrast = (weight * (template - level[:, None, None]).square()).sum((1, 2)) / full
    return contrast.sqrt() > 1e-6 * (1.0 + level.abs())


def weighted_correlation(template: Tensor, weight: Tensor, wide: Tensor, usable: Tensor) -> Tensor:
    """Normalized correlation (N, rows, columns) of templates (N, h, w) with wider patches, at every whole shift.

    Shifts that touch what is not usable have -1, and so have flat templates. Patches (N, h, w), which have one place
    each, may share one template (1, h, w).
    """
    count = len(template)
    total = weight.sum((1, 2)).clamp_min(1e-12)
    mean = (weight * template).sum((1, 2)) / total
    centered = weight * (template - mean[:, None, None])
    # Centered, so that squares do not cancel.
    other = wide - (wide.mean((1, 2)))[:, None, None]

    def over(values: Tensor, kernel: Tensor) -> Tensor:
        if values.shape[1:] == kernel.shape[1:]:
            return (values * kernel).sum((1, 2), keepdim=True)
        found: Tensor = torch.nn.functional.conv2d(values[None], kernel[:, None], groups=count)[0]
        return found

    product = over(other, centered)
    average = over(other, weight) / total[:, None, None]
    power = (over(other.square(), weight) / total[:, None, None] - average.square()).clamp_min(0.0)
    own = ((weight * (template - mean[:, None, None]).square()).sum((1, 2)) / total).clamp_min(0.0)
    norm = total[:, None, None] * (power * own[:, None, None]).sqrt()
    blocked = over((~usable).double(), (weight > 0).double()) > 0.5
    good = ~blocked & (norm > 1e-9 * total[:, None, None] * (1.0 + template.abs().amax((1, 2))[:, None, None]))
    return torch.where(good, product / torch.where(good, norm, 1.0), -1.0)


class Peak(NamedTuple):
    """The best of the places of each of N patches.

    Attributes:
        number: (N,) its number, row by row.
        place: (N, 2).
        score: (N,) correlation there.
        rival: (N,) that of the best other peak farther than `RIVAL_DISTANCE`; -1 without one.
        edge: (N,) whether it is in the first or last column.
    """

    number: Tensor
    place: Tensor
    score: Tensor
    rival: Tensor
    edge: Tensor


def highest_peak(scores: Tensor, places: Tensor) -> Peak:
    """The highest of correlations (N, rows, columns) at places (rows, columns, 2), and its rival.

    Example:
        >>> row = torch.tensor([[[0.1, 0.9, 0.2, 0.1, 0.3, 0.8, 0.2]]])
        >>> places = torch.stack([torch.arange(7.0), torch.zeros(7)], -1)[None]
        >>> peak = highest_peak(row, places)
        >>> peak.place.tolist(), round(float(peak.rival), 1)
        ([[1.0, 0.0]], 0.8)
    """
    columns = scores.shape[2]
    score, index = scores.flatten(1).max(1)
    place, column = places.flatten(0, 1)[index], index % columns
    inner = torch.nn.functional.max_pool2d(scores[:, None], 3, stride=1, padding=1)[:, 0]
    away = torch.linalg.vector_norm(places - place[:, None, None], dim=-1) > RIVAL_DISTANCE
    x = torch.arange(columns, device=scores.device)
    peaks = (scores >= inner) & away & (x > 0) & (x < columns - 1)
    rival = torch.where(peaks, scores, -1.0).flatten(1).amax(1)
    return Peak(index, place, score, rival, (column == 0) | (column == columns - 1))
