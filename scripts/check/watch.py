"""A watched rig on simulated looks: drifts found, false alarms, thermal swing removed, coverage of targets at 5 km.

Nothing is rendered. Looks have the errors that were measured of patches (docs/measured/scene.md): 0.1 px each, 300 of
them in a camera of f 1600 px, a third of the variance lasting for hours; 0.5 % of the looks are wrong by 0.05°. Masts
follow the air and the sun, each camera in its own way: a relative swing (below the limit of the alarm, or
beyond) that is no process of the model. Wind turns both at every look, by 0.0002 to 0.0008°. Three of five rigs see
nothing at night, the others an eighth of the features; there are gaps of half an hour. Each rig's model is learned from
three days before those that count.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal import Localizer, Origin, Rig
from kcal.lens import rotation_from_vector
from kcal.rig import Mounting, RigCovariance, planned_rig
from kcal.watch.history import AngleSeries, Look, TurnModel, between_rows, first_state, learned, passed, taken, turns_of
from kcal.watch.turned import drift_of_turns
from kcal.watch.watcher import LIMIT, exceeded
from scripts.shared.page import Lines, section, table

RIG = planned_rig()
ROWS = between_rows(RIG)
# Radians of one feature of 0.1 px then and now: pitch, yaw, roll (an image is some 0.3 wide at the middle).
FEATURE = 0.1 * math.sqrt(2.0) / 1600.0 * torch.tensor([1.0, 1.0, 3.5], dtype=torch.float64).repeat(2)
FEATURES, LASTING, LASTING_S = 300, 0.33, 7200.0
DRIFT = math.radians(0.01)
RIG_YAW = 0.001  # degrees, of the rig file
MARK = 0.02  # px, of targets: means of many frames
LEARN = 3.0  # days
# Degrees of the largest relative turn that air and sun make: below the limit of the alarm, and what a steel beam does.
MILD, STRONG = (0.001, 0.0045), (0.005, 0.03)
DAY = 86400.0


class Truth(NamedTuple):
    """T looks at C rigs.

    Attributes:
        slow: (T, C, 6) radians, without wind.
        wind: (C,) radians of a gust.
        kelvin: (T, C).
        seen: (T, C) features, 0 in a gap.
    """

    slow: Tensor
    wind: Tensor
    kelvin: Tensor
    seen: Tensor


def walk(count: int, chains: int, step_s: float, last_s: float, random: torch.Generator, width: int = 1) -> Tensor:
    """(T, C, width) of a process with variance 1 that forgets itself in `last_s`."""
    keep = math.exp(-step_s / last_s)
    noise = torch.randn(count, chains, width, generator=random, dtype=torch.float64)
    values = [noise[0]]
    for k in range(1, count):
        values.append(keep * values[-1] + math.sqrt(1.0 - keep * keep) * noise[k])
    return torch.stack(values)


def truth(chains: int, days: float, every: float, seed: int, peaks: tuple[float, float] = MILD) -> Truth:
    """What happens."""
    random = torch.Generator().manual_seed(seed)
    count = int(days * DAY / every)
    clock = (torch.arange(count).double() * every + 8 * 3600.0)[:, None]  # it begins at 8 o'clock
    weather = walk(count, chains, every, 6 * 3600.0, random)[..., 0]
    hour = clock / 3600.0 % 24.0
    air = 5.0 * torch.cos(2 * math.pi * (hour - 15.0) / 24.0) + 1.5 * weather
    clouds = walk(count, chains, every, 1800.0, random)[..., 0]
    sun = torch.sin(math.pi * (hour - 6.0) / 12.0).clamp_min(0.0) * (0.7 + 0.3 * torch.tanh(clouds))
    # Steel takes half an hour.
    lag, heated = math.exp(-every / 1800.0), [sun[0]]
    for value in sun[1:]:
        heated.append(lag * heated[-1] + (1.0 - lag) * value)
    part = torch.randn(2, chains, 6, generator=random, dtype=torch.float64) * torch.tensor([0.4, 1.0, 0.3]).repeat(2)
    slow = (air - air[:1])[..., None] / 10.0 * part[0] + (torch.stack(heated) - heated[0])[..., None] * 0.5 * part[1]
    relative = (slow @ ROWS[:3].T).abs().amax((0, 2))
    peak = math.radians(1.0) * (peaks[0] + (peaks[1] - peaks[0]) * torch.rand(chains, generator=random).double())
    slow = slow * (peak / relative)[:, None]
    night = ((hour < 6.0) | (hour > 20.0)).expand(count, chains)
    blind = torch.rand(chains, generator=random) < 0.6
    seen = torch.where(night, torch.where(blind, 0.0, FEATURES / 8.0), float(FEATURES)).double()
    gaps = walk(count, chains, every, 1800.0, random)[..., 0] > 2.0
    seen = torch.where(gaps, 0.0, seen)
    seen[0] = FEATURES
    wind = math.radians(1.0) * (0.0002 + 0.0006 * torch.rand(chains, generator=random, dtype=torch.float64))
    return Truth(slow, wind, air - air[:1], seen)


def looks(true: Truth, every: float, seed: int, *, heat: bool) -> list[Look]:
    """What is measured of it."""
    random = torch.Generator().manual_seed(seed)
    count, chains = true.seen.shape
    steady = walk(count, chains, every, LASTING_S, random, 6)
    found = []
    for k in range(count):
        some = true.seen[k].clamp_min(1.0)
        sigma = FEATURE / some.sqrt()[:, None]

        def noise() -> Tensor:
            return torch.randn(chains, 6, generator=random, dtype=torch.float64)

        turn = true.slow[k] + true.wind[:, None] * noise()
        turn = turn + sigma * (math.sqrt(1.0 - LASTING) * noise() + math.sqrt(LASTING) * (steady[k] - steady[0]))
        wrong = torch.rand(chains, 1, generator=random) < 0.005
        turn = torch.where(wrong & (k > 0), turn + math.radians(0.05) * noise(), turn)
        seen = (true.seen[k] > 0)[:, None].expand(chains, 2)
        zero = torch.zeros(chains, dtype=torch.float64)
        found.append(Look(
            turn=turn, covariance=torch.diag_embed(sigma**2), lasting=zero + LASTING, seen=seen,
            between=zero[:, None].expand(chains, 5),
            between_covariance=torch.eye(5, dtype=torch.float64).expand(chains, 5, 5),
            matched=torch.zeros(chains, dtype=torch.bool), kelvin=true.kelvin[k] if heat else zero,
        ))  # fmt: skip
    return found


def learned_each(true: Truth, found: list[Look], every: float) -> TurnModel:
    """The model of each rig from its looks, every sixth of them."""
    which = range(0, len(found), 6)
    turn = torch.stack([found[k].turn for k in which])
    seen = torch.stack([found[k].seen for k in which]).repeat_interleave(3, -1)
    own = torch.stack([found[k].covariance.diagonal(dim1=-2, dim2=-1) for k in which])
    kelvin = torch.stack([found[k].kelvin for k in which])[..., None].expand_as(turn)
    flat = [values.flatten(1).numpy() for values in (
        torch.where(seen, turn, math.nan), (1.0 - LASTING) * own, LASTING * own, kelvin)]  # fmt: skip
    model = learned(AngleSeries(every * torch.tensor(which).double().numpy(), *flat))
    return TurnModel(
        **{name: getattr(model, name).reshape(-1, 6) for name in ("swing", "return_s", "gust")})  # fmt: skip


class Told(NamedTuple):
    """What the filter told after each of T looks at C rigs: the lasting turn, and that of half a look later with wind.

    Attributes:
        steady: (T, C, 3) relative turn without wind.
        sigma: (T, C, 3).
        later: (T, C, 6) turns of both cameras.
        covariance: (T, C, 6, 6).
    """

    steady: Tensor
    sigma: Tensor
    later: Tensor
    covariance: Tensor


def filtered(found: list[Look], every: float, model: TurnModel) -> Told:
    """What is told, without looks of later."""
    chains = len(found[0].kelvin)
    state, told = first_state(model, (chains,)), []
    seconds = torch.full((chains,), every, dtype=torch.float64)
    for k, look in enumerate(found):
        if k:
            state, _ = passed(state, seconds, model)
        state = taken(state, look, model, ROWS)
        steady = turns_of(state, model, gusts=False)
        covariance = ROWS[:3] @ steady.covariance @ ROWS[:3].T
        later = turns_of(passed(state, 0.5 * seconds, model)[0], model)
        told.append((steady.mean @ ROWS[:3].T, covariance.diagonal(dim1=-2, dim2=-1).sqrt(), *later))
    return Told(*(torch.stack(values) for values in zip(*told, strict=True)))


def in_interval(watched: Rig, standing: Rig, seed: int) -> bool:
    """Whether the interval of a target at 5 km contains its range, when the rig stands otherwise than believed."""
    random = torch.Generator().manual_seed(seed)
    place = torch.tensor([[0.0, 0.0, 5000.0]]) + torch.tensor([[400.0, 200.0, 0.0]]) * (
        2.0 * torch.rand(1, 3, generator=random) - 1.0)  # fmt: skip
    left, right = standing(place.double())[0].unbind(-2)
    marks = [pixels + MARK * torch.randn(1, 2, generator=random, dtype=torch.float64) for pixels in (left, right)]
    found = Localizer(watched, pixel_sigma=MARK)(*marks)
    return bool(found.range_low[0] <= place.norm() <= found.range_high[0])


def coverage(true: Truth, told: Told, number: int) -> dict[str, Tensor]:
    """Of targets at random moments of all rigs: (number,) in the interval with the watch, without, in the dark."""
    random = torch.Generator().manual_seed(7)
    count, chains = true.seen.shape
    pose = torch.zeros(6, 6, dtype=torch.float64)
    pose[1, 1] = math.radians(RIG_YAW) ** 2
    file = planned_rig()
    file.covariance = RigCovariance.of(file, pose=pose)
    file.mounting = Mounting(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0)
    inside: dict[str, list[bool]] = {"watch": [], "file": [], "night": []}
    for n in range(number):
        k = int(torch.randint(count, (1,), generator=random))
        c = int(torch.randint(chains, (1,), generator=random))
        # The rig of the file was solved with an error of its sigma, and has bent since; wind at the moment.
        error = torch.tensor([0.0, math.radians(RIG_YAW), 0.0], dtype=torch.float64)
        error = error * torch.randn(1, generator=random, dtype=torch.float64)
        bent = true.slow[k, c] + true.wind[c] * torch.randn(6, generator=random, dtype=torch.float64)
        then = rotation_from_vector(error)
        solved = Rig.pair(file.left, file.right, then @ file.right_from_left_rotation, file.right_from_left_translation)
        standing = drift_of_turns(solved, bent, torch.eye(6, dtype=torch.float64)).rig
        watched = drift_of_turns(file, told.later[k, c], told.covariance[k, c]).relocked("")
        inside["watch"].append(in_interval(watched, standing, n))
        inside["file"].append(in_interval(file, standing, n))
        inside["night"].append(bool(true.seen[k, c] < FEATURES))
    return {name: torch.tensor(values) for name, values in inside.items()}


def percent(values: Tensor) -> str:
    """A share with its standard error."""
    share = float(values.double().mean())
    return f"{100 * share:.1f} ± {100 * math.sqrt(share * (1 - share) / max(1, len(values))):.1f} %"


@torch.no_grad()
def day_and_night(
    chains: int, days: float, every: float, targets: int, peaks: tuple[float, float], *, heat: bool
) -> tuple[list[object], TurnModel]:
    """A row of the table, after `LEARN` days from which each rig's model is learned."""
    true = truth(chains, LEARN + days, every, 1, peaks)
    found, skip = looks(true, every, 2, heat=heat), int(LEARN * DAY / every)
    model = learned_each(true, found[:skip], every)
    told = Told(*(values[skip:] for values in filtered(found, every, model)))
    true = true._replace(slow=true.slow[skip:], seen=true.seen[skip:], kelvin=true.kelvin[skip:])
    raised = exceeded(told.steady, told.sigma, LIMIT, every).any(-1)
    false = raised & ((true.slow @ ROWS[:3].T).abs().amax(-1) < math.radians(LIMIT))
    begins = int((false[1:] & ~raised[:-1]).sum()) + int(false[0].sum())
    really, day = true.slow @ ROWS[1], true.seen == FEATURES
    left = told.steady[..., 1] - really
    swing = [1.0 - math.sqrt(float(left[w].square().mean() / really[w].square().mean())) for w in (day, ~day)]
    inside = coverage(true, told, targets)
    night = inside["night"]
    return [
        f"{peaks[0]} to {peaks[1]}°", "yes" if heat else "no", f"{chains * days:.0f}", begins,
        f"{begins / (chains * days / 30.0):.2f}",
        *(f"{100 * share:.1f} %" for share in swing), percent(inside["watch"][~night]), percent(inside["watch"][night]),
        percent(inside["file"]),
    ], model  # fmt: skip


@torch.no_grad()
def drifts(chains: int, every: float, model: TurnModel) -> Lines:
    """How soon a drift of the relative yaw is found, by day."""
    for words, ramp_s in (("at once", 1.0), ("in 10 minutes", 600.0)):
        true = truth(chains, LEARN + 0.4, every, 1)
        skip = int(LEARN * DAY / every)
        random = torch.Generator().manual_seed(12)
        begin = torch.randint(skip // 12, skip // 6, (chains,), generator=random)
        since = (torch.arange(skip // 4)[:, None] - begin).double() * every
        sign = torch.where(torch.rand(chains, generator=random) < 0.5, -1.0, 1.0).double()
        slow = true.slow[: skip // 4].clone()
        slow[..., 4] += (since / ramp_s).clamp(0.0, 1.0) * DRIFT * sign
        short = true._replace(slow=slow, seen=true.seen[: skip // 4], kelvin=true.kelvin[: skip // 4])
        told = filtered(looks(short, every, 13, heat=False), every, model)
        ever = (exceeded(told.steady, told.sigma, LIMIT, every).any(-1) & (since >= 0)).double()
        at = torch.where(ever.any(0), since.gather(0, ever.argmax(0)[None])[0], math.inf)
        seen = (true.seen[: skip // 4] > 0) & (since >= 0) & (since <= 600.0)
        by = (at[seen.sum(0) >= 3] <= 600.0 + (ramp_s if ramp_s > 1 else 0.0)).double()
        yield [words, len(by), f"{100 * float(by.mean()):.1f} %", f"{float(at.median()) / 60:.0f} min",
               f"{100 * float((at <= 3600.0).double().mean()):.1f} %"]  # fmt: skip


@section("watch.md", "swing", chains=5, days=0.1, every=1200.0, targets=10)
def swing(chains: int = 200, days: float = 5.0, every: float = 120.0, targets: int = 2000) -> Lines:
    heads = ["swing", "temperature", "days and nights", "false alarms", "a month", "of the swing removed by day"]
    heads += ["in dark and gaps", "inside 95 % by day", "inside, dark and gaps", "inside, rig file"]
    # Alarms need the thousand days.
    yield heads
    for peaks, heat, part in ((STRONG, True, 5), (STRONG, False, 5), (MILD, True, 5), (MILD, False, 1)):
        yield day_and_night(chains // part, days, every, targets, peaks, heat=heat)[0]


@section("watch.md", "drift", chains=5, every=1200.0)
def drift(chains: int = 200, every: float = 120.0) -> Lines:
    """The model is that of a mild swing without temperatures."""
    model = day_and_night(chains, 0.1, every, 1, MILD, heat=False)[1]
    heads = ["drift of 0.01°", "rigs", "found in 10 minutes of its end", "median", "in an hour"]
    return table(heads, drifts(chains, every, model))
