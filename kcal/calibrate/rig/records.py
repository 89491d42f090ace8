"""Report a solved rig: residuals of every item and of every source, in pixels, meters and sigmas."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import get_args

import torch
from torch import Tensor

from kcal.calibrate.rig.adjustment import Adjustment
from kcal.calibrate.rig.blocks import KINDS, Kind, PerKind
from kcal.calibrate.rig.limits import over_limit
from kcal.calibrate.rig.result import ItemResidual, Source, SourceResidual
from kcal.solve.lm import LMOptions

# Reasons for leaving items out, by their indices.
Reasons = Mapping[Kind, Mapping[int, str]]
# Fewest marks of an item whose residuals say anything about it.
_MARKS: Mapping[Kind, int] = {"boards": 4, "landmarks": 1, "features": 2, "stars": 1}
# 1/m: features are drawn no farther away than 100 km.
_LEAST_INVERSE_RANGE = 1e-5


def item_records(work: Adjustment, masks: PerKind, reasons: Reasons) -> tuple[ItemResidual, ...]:
    """One record for each board, landmark, feature, baseline and position.

    What was left out is compared with where the others put it: a landmark at its surveyed place, a board or feature at
    the place that suits it best.
    """
    items: list[ItemResidual] = []
    outside = PerKind(*(~mask & _marked(work, kind, mask) for kind, mask in zip(KINDS, masks, strict=True)))
    if any(bool(mask.any()) for mask in outside):
        work.solve(outside, LMOptions(residual_floor=1e-8), held=True)
    for used, chosen in ((True, masks), (False, outside)):
        squares, freedom, pixels = work.squares(chosen), work.freedom(chosen), _rms_by_camera(work, chosen, used)
        over = over_limit(work, chosen, work.deletions(chosen)) if used else over_limit(work, chosen, squares, 0.999)
        for k, kind in enumerate(KINDS):
            times = work.widened[kind]
            for i in chosen[k].nonzero()[:, 0].tolist():
                sigmas = times * math.sqrt(float(squares[k][i]) / max(int(freedom[k][i]), 1))
                why = (
                    ""
                    if used
                    else reasons[kind].get(i) or _contradiction(work, kind, pixels[kind][i], sigmas, float(over[k][i]))
                )
                items.append(
                    ItemResidual(
                        source=kind,
                        name=work.names(kind)[i],
                        pixels=pixels[kind][i],
                        meters=_off_survey(work, i) if kind == "landmarks" else None,
                        sigmas=sigmas,
                        over_limit=float(over[k][i]),
                        used=used,
                        reason=why,
                    )
                )
    for kind, mask, marked in zip(KINDS, masks, outside, strict=True):
        for i in (~mask & ~marked).nonzero()[:, 0].tolist():
            name, why = work.names(kind)[i], reasons[kind][i]
            items.append(
                ItemResidual(source=kind, name=name, sigmas=math.inf, over_limit=math.inf, used=False, reason=why)
            )
    items += _measurement_records(work)
    order = list(get_args(Source))
    return tuple(sorted(items, key=lambda item: (order.index(item.source), not item.used)))


def source_records(work: Adjustment, masks: PerKind, items: Sequence[ItemResidual]) -> tuple[SourceResidual, ...]:
    """Each source that there is."""
    squares, freedom, found = work.squares(masks), work.freedom(masks), list[SourceResidual]()
    problem, state = work.problem(masks), work.part(masks)
    rms_px: dict[Source, float] = {
        block.kind: math.sqrt(float(block.errors(problem.posed(state), state).square().sum()) / int(block.seen.sum()))
        for block in problem.blocks
    }
    skyline = work.data.skyline
    if skyline is not None:
        squares_px = [many * px**2 for many, px in zip(skyline.columns, skyline.rms_px, strict=True)]
        rms_px["skyline"] = math.sqrt(sum(squares_px) / sum(skyline.columns))
    for source in get_args(Source):
        own = [item for item in items if item.source == source]
        if not own:
            continue
        sigmas = _root_mean_square([item.sigmas for item in own])
        if source in KINDS:
            k = KINDS.index(source)
            total, dof = float(squares[k].nansum()), int(freedom[k].sum())
            sigmas = work.widened[KINDS[k]] * math.sqrt(total / dof) if dof > 0 else math.nan
        meters = [item.meters for item in own if item.used and item.meters is not None]
        found.append(
            SourceResidual(
                source=source,
                used=sum(item.used for item in own),
                left_out=sum(not item.used for item in own),
                rms_px=rms_px.get(source),
                rms_m=_root_mean_square(meters) if meters else None,
                sigmas=sigmas,
            )
        )
    return tuple(found)


def _root_mean_square(values: Sequence[float]) -> float:
    return math.sqrt(sum(value**2 for value in values) / len(values))


def _marked(work: Adjustment, kind: Kind, mask: Tensor) -> Tensor:
    source = getattr(work.data, kind)
    if source is None:
        return mask.clone()
    return torch.isfinite(source.pixels).all(-1).flatten(1).sum(-1) >= _MARKS[kind]


def _rms_by_camera(work: Adjustment, masks: PerKind, used: bool) -> dict[Kind, dict[int, tuple[float | None, ...]]]:
    """RMS distance in pixels of each item in each camera; of landmarks that are not used, from their surveyed place."""
    problem, state = work.problem(masks), work.part(masks)
    if not used and work.data.landmarks is not None:
        state = state._replace(points=work.data.landmarks.points[masks.landmarks])
    found: dict[Kind, dict[int, tuple[float | None, ...]]] = {}
    for block in problem.blocks:
        squared, count = block.errors(problem.posed(state), state).square().sum((2, 3)), block.seen.sum(-1)
        rms = (squared / count.clamp_min(1)).sqrt().nan_to_num(math.inf)
        rows = [
            tuple(value if n else None for value, n in zip(values, ns, strict=True))
            for values, ns in zip(rms.tolist(), count.tolist(), strict=True)
        ]
        found[block.kind] = dict(zip(getattr(masks, block.kind).nonzero()[:, 0].tolist(), rows, strict=True))
    return found


def _off_survey(work: Adjustment, index: int) -> float:
    assert work.data.landmarks is not None
    return float(torch.linalg.vector_norm(work.state.points[index] - work.data.landmarks.points[index]))


def _contradiction(work: Adjustment, kind: Kind, pixels: Sequence[float | None], sigmas: float, over: float) -> str:
    seen = [(value, name) for value, name in zip(pixels, work.data.names, strict=True) if value is not None]
    text = ", ".join(
        f"{value:.2g} px in {name}" if math.isfinite(value) else f"not seen by {name}" for value, name in seen
    )
    if kind == "landmarks":
        return f"its marks are off the surveyed place by {text} ({sigmas:.0f} sigma): a wrong mark or survey"
    if kind == "features":
        return f"its marks do not meet: off by {text} ({sigmas:.0f} sigma): not the same thing, or it moved"
    if kind == "stars":
        return f"off by {text} ({sigmas:.0f} sigma): not that star, or an aircraft or satellite"
    why = "it moved between the views, or a lens differs from its model"
    # A board of many corners is wrong at few sigmas. One that is within its own limit was left out because the others
    # fit better without it (`outliers.without_wrong`).
    if over > 1.0:
        most = f"{sigmas:.2f} sigma on average, where so many corners allow {sigmas / math.sqrt(over):.2f}"
        return f"it does not fit the other boards: off by {text} ({most}): {why}"
    return (
        "it does not fit the other boards: with it, these fit worse than chance explains, though it is off by only "
        f"{text} ({sigmas:.2f} sigma on average): {why}"
    )


def _measurement_records(work: Adjustment) -> list[ItemResidual]:
    data, center, out = work.data, work.state.center, []
    for b in data.baselines:
        error = float(torch.linalg.vector_norm(center[b.first] - center[b.second])) - b.length
        name = f"{data.names[b.first]} to {data.names[b.second]}"
        out.append(ItemResidual(source="baselines", name=name, meters=error, sigmas=abs(error) / b.sigma))
    if data.skyline is not None:
        own = zip(data.skyline.names, data.skyline.cameras, data.skyline.rms_px, data.skyline.sigmas, strict=True)
        for name, camera, rms, sigmas in own:
            pixels = tuple(rms if c == camera else None for c in range(len(data.cameras)))
            out.append(ItemResidual(source="skyline", name=name, pixels=pixels, sigmas=sigmas))
    for p in data.positions:
        off = center[p.camera] - p.point
        sigmas = math.sqrt(float((off / p.sigma).square().mean()))
        meters = float(torch.linalg.vector_norm(off))
        out.append(ItemResidual(source="positions", name=data.names[p.camera], meters=meters, sigmas=sigmas))
    return out


def places(work: Adjustment) -> dict[Source, dict[str, Tensor]]:
    """Positions (3,) of boards (their middle), landmarks and features in the local frame, by name."""
    data, state, found = work.data, work.state, dict[Source, dict[str, Tensor]]()
    if data.boards is not None:
        middle = data.boards.points.mean(0)
        where = state.board_rotation @ middle + state.board_translation
        found["boards"] = dict(zip(data.boards.names, where, strict=True))
    if data.landmarks is not None:
        found["landmarks"] = dict(zip(data.landmarks.names, state.points, strict=True))
    if data.features is not None:
        far = work.anchor + state.direction / state.inverse_range.clamp_min(_LEAST_INVERSE_RANGE)[:, None]
        found["features"] = dict(zip(data.features.names, far, strict=True))
    return found
