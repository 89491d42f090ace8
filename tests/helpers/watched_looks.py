"""Looks at a rig that turns as a model says, without images."""

import math

import torch
from torch import Tensor

from kcal.watch.history import LASTING_S, HistoryRow, Look, TurnModel, no_look

SIGMA, SHARE = 4e-6, 0.3
START = 1_777_636_800.0


def steady_model(swing_deg: float = 0.004, hours: float = 3.0, gust_deg: float = 0.0004) -> TurnModel:
    """All six angles alike."""
    values = math.radians(swing_deg), 3600.0 * hours, math.radians(gust_deg)
    return TurnModel(**{
        name: torch.full((6,), value, dtype=torch.float64)
        for name, value in zip(("swing", "return_s", "gust"), values, strict=True)
    })  # fmt: skip


def simulated(model: TurnModel, count: int, every: float, rigs: int, seed: int) -> tuple[Tensor, list[Look]]:
    """(T, C, 6) the turns without wind, and looks at them."""
    random = torch.Generator().manual_seed(seed)

    def noise() -> Tensor:
        return torch.randn(rigs, 6, generator=random, dtype=torch.float64)

    slow, lasting = model.swing * noise(), math.sqrt(SHARE) * SIGMA * noise()
    keep, stays = torch.exp(-every / model.return_s), math.exp(-every / LASTING_S)
    true, looks, zero = [], [], torch.zeros(rigs, dtype=torch.float64)
    for k in range(count):
        if k:
            slow = keep * slow + (1.0 - keep**2).sqrt() * model.swing * noise()
            lasting = stays * lasting + math.sqrt((1.0 - stays**2) * SHARE) * SIGMA * noise()
        true.append(slow)
        turn = slow + lasting + model.gust * noise() + math.sqrt(1.0 - SHARE) * SIGMA * noise()
        looks.append(Look(
            turn=turn, covariance=SIGMA**2 * torch.eye(6).double().expand(rigs, 6, 6), lasting=zero + SHARE,
            seen=torch.ones(rigs, 2, dtype=torch.bool), between=zero[:, None].expand(rigs, 5),
            between_covariance=torch.eye(5).double().expand(rigs, 5, 5), matched=zero.bool(), kelvin=zero,
        ))  # fmt: skip
    return torch.stack(true), looks


def row_of(time: float, turn: Tensor | None, kelvin: float = 0.0, note: str = "") -> HistoryRow:
    """A row in which both cameras were seen to have turned, or nothing was seen."""
    look = no_look()._replace(kelvin=torch.tensor(kelvin, dtype=torch.float64))
    if turn is not None:
        look = look._replace(
            turn=turn, covariance=SIGMA**2 * torch.eye(6).double(), lasting=torch.tensor(SHARE).double(),
            seen=torch.ones(2, dtype=torch.bool),
        )  # fmt: skip
    return HistoryRow(time, look, (300, 290), 0, math.nan, note)


def yaw_turn(degrees: float) -> Tensor:
    """(6,) radians: the right camera has turned about its y axis."""
    return torch.tensor([0.0, 0.0, 0.0, 0.0, math.radians(degrees), 0.0], dtype=torch.float64)
