"""What is told of a solved rig: residuals of every item and of every source, in pixels, meters and sigmas."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import get_args

import torch
from torch import Tensor

from kcal.calibrate.rig.adjustment import KINDS, Adjustment, Source
from kcal.calibrate.rig.result import ItemResidual, SourceResidual
from kcal.solve.lm import LMOptions

# One over meters: features are drawn no farther away.
_FARTHEST = 1e-5


def item_records(
    work: Adjustment, masks: Sequence[Tensor], reasons: Sequence[dict[int, str]]
) -> tuple[ItemResidual, ...]:
    """One record for each board, landmark, feature, baseline and position.

    What was left out is compared with where the others put it: a landmark at its surveyed place, a board or feature at
    the place that suits it best.
    """
    items: list[ItemResidual] = []
    outside = [~mask & _seen(work, kind, mask) for kind, mask in zip(KINDS, masks, strict=True)]
    if any(bool(mask.any()) for mask in outside):
        work.solve(outside, LMOptions(residual_floor=1e-8), held=True)
    for used, chosen in ((True, list(masks)), (False, outside)):
        squares, freedom = work.squares(chosen), work.freedom(chosen)
        pixels = _pixels(work, chosen, surveyed=not used)
        for k, kind in enumerate(KINDS):
            names = () if len(chosen[k]) == 0 else getattr(work.data, kind).names
            for i in chosen[k].nonzero()[:, 0].tolist():
                sigmas = math.sqrt(float(squares[k][i]) / max(int(freedom[k][i]), 1))
                items.append(
                    ItemResidual(
                        source=kind,
                        name=names[i],
                        pixels=pixels[k][i],
                        meters=_moved(work, i) if kind == "landmarks" else None,
                        sigmas=sigmas,
                        used=used,
                        reason="" if used else reasons[k].get(i) or _reason(work, kind, pixels[k][i], sigmas),
                    )
                )
    for k, kind in enumerate(KINDS):
        for i in (~masks[k] & ~outside[k]).nonzero()[:, 0].tolist():
            name = getattr(work.data, kind).names[i]
            items.append(ItemResidual(source=kind, name=name, sigmas=math.inf, used=False, reason=reasons[k][i]))
    items += _measured(work)
    order = list(get_args(Source))
    return tuple(sorted(items, key=lambda item: (order.index(item.source), not item.used)))


def source_records(
    work: Adjustment, masks: Sequence[Tensor], items: Sequence[ItemResidual]
) -> tuple[SourceResidual, ...]:
    """Each source that there is."""
    squares, freedom = work.squares(masks), work.freedom(masks)
    problem, state = work.problem(masks), work.part(masks)
    sights, found = problem.sights(state), []
    for k, (kind, group, local) in enumerate(zip(KINDS, problem.groups, problem.locals(state), strict=True)):
        own = [item for item in items if item.source == kind]
        if not own:
            continue
        errors, count = group.errors(sights, local), int(group.seen.sum())
        meters = [item.meters for item in own if item.used and item.meters is not None]
        total, dof = float(squares[k][masks[k]].sum()), int(freedom[k].sum())
        found.append(
            SourceResidual(
                source=kind,
                used=sum(item.used for item in own),
                left_out=sum(not item.used for item in own),
                rms_px=math.sqrt(float(errors.square().sum()) / count) if count else None,
                rms_m=_rms(meters),
                sigmas=math.sqrt(total / dof) if dof > 0 else math.nan,
            )
        )
    for kind in ("baselines", "positions"):
        own = [item for item in items if item.source == kind]
        if own:
            meters = [item.meters for item in own if item.meters is not None]
            sigmas = _rms([item.sigmas for item in own]) or 0.0
            found.append(
                SourceResidual(
                    source=own[0].source, used=len(own), left_out=0, rms_px=None, rms_m=_rms(meters), sigmas=sigmas
                )
            )
    return tuple(found)


def _rms(values: Sequence[float]) -> float | None:
    return math.sqrt(sum(value**2 for value in values) / len(values)) if values else None


def _seen(work: Adjustment, kind: Source, mask: Tensor) -> Tensor:
    source = getattr(work.data, kind)
    if source is None:
        return mask.clone()
    marks = torch.isfinite(source.pixels).all(-1).flatten(1).sum(-1)
    return marks >= {"boards": 4, "landmarks": 1, "features": 2}[kind]


def _pixels(work: Adjustment, masks: Sequence[Tensor], *, surveyed: bool) -> list[dict[int, tuple[float | None, ...]]]:
    """RMS distance of each item in each camera; landmarks from their surveyed place if asked."""
    problem, state = work.problem(masks), work.part(masks)
    sights, found = problem.sights(state), []
    for kind, mask, group, local in zip(KINDS, masks, problem.groups, problem.locals(state), strict=True):
        if surveyed and kind == "landmarks" and work.data.landmarks is not None:
            local = (work.data.landmarks.points[mask],)
        squared, count = group.errors(sights, local).square().sum((2, 3)), group.seen.sum(-1)
        rms = (squared / count.clamp_min(1)).sqrt().nan_to_num(math.inf)
        rows = [
            tuple(value if n else None for value, n in zip(values, ns, strict=True))
            for values, ns in zip(rms.tolist(), count.tolist(), strict=True)
        ]
        found.append(dict(zip(mask.nonzero()[:, 0].tolist(), rows, strict=True)))
    return found


def _moved(work: Adjustment, index: int) -> float:
    assert work.data.landmarks is not None
    return float(torch.linalg.vector_norm(work.state[5][index] - work.data.landmarks.points[index]))


def _reason(work: Adjustment, kind: Source, pixels: Sequence[float | None], sigmas: float) -> str:
    seen = [(value, name) for value, name in zip(pixels, work.data.names, strict=True) if value is not None]
    text = ", ".join(
        f"{value:.2g} px in {name}" if math.isfinite(value) else f"not seen by {name}" for value, name in seen
    )
    if kind == "landmarks":
        return f"its marks are off the surveyed place by {text} ({sigmas:.0f} sigma): a wrong mark or survey"
    if kind == "features":
        return f"its marks do not meet: off by {text} ({sigmas:.0f} sigma): not the same thing, or it moved"
    why = "not taken at the same moment, or where a lens is not its model?"
    return f"it does not fit the other boards: {text} ({sigmas:.1f} times typical): {why}"


def _measured(work: Adjustment) -> list[ItemResidual]:
    data, center, out = work.data, work.state[2], []
    for b in data.baselines:
        error = float(torch.linalg.vector_norm(center[b.first] - center[b.second])) - b.length
        name = f"{data.names[b.first]} to {data.names[b.second]}"
        out.append(ItemResidual(source="baselines", name=name, meters=error, sigmas=abs(error) / b.sigma))
    for p in data.positions:
        error3 = center[p.camera] - p.point
        sigmas = math.sqrt(float((error3 / p.sigma).square().mean()))
        length = float(torch.linalg.vector_norm(error3))
        out.append(ItemResidual(source="positions", name=data.names[p.camera], meters=length, sigmas=sigmas))
    return out


def places(work: Adjustment) -> dict[Source, tuple[tuple[str, ...], Tensor]]:
    """Names and positions (N, 3) of boards (their middle), landmarks and features in the local frame."""
    found: dict[Source, tuple[tuple[str, ...], Tensor]] = {}
    _, _, _, rotation, translation, points, direction, inverse = work.state
    if work.data.boards is not None:
        middle = work.data.boards.board.points.mean(0)
        found["boards"] = work.data.boards.names, rotation @ middle + translation
    if work.data.landmarks is not None:
        found["landmarks"] = work.data.landmarks.names, points
    if work.data.features is not None:
        far = direction / inverse.clamp_min(_FARTHEST)[:, None]
        found["features"] = work.data.features.names, work.anchor + far
    return found
