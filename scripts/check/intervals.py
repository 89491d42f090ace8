"""Does `kcal check` judge right? Its verdict on calibrations whose truth is known.

Captures are those of `scripts.check.captures_that_move`: three traced lenses in turn, printed boards, noise of
0.08 px; 5, 8, 12 and 20 views in turn, every other one by hand. Each is calibrated with the default lens, whose
intervals should be true, and with opencv5, which describes neither lens nor board, so that they should not. A second
capture of the same lens and board, with as many views, is what `--against` gets. Truth: the share of the image in which
the true lens lies in the stated 95 % ellipses, at infinity after the best-fit rotation. Intervals count as true where
it is more than half: places of one calibration go together, so that true intervals have all of the image inside or,
seldom, little of it.
"""

from __future__ import annotations

import itertools
import math
import statistics
import time

from kcal import CalibrationOptions, KcalError, calibrate_camera
from kcal.calibrate.camera.trust import against_capture, interval_check, simulated_capture, simulated_refits
from kcal.lens.uncertainty import pixel_covariance, pixel_errors
from kcal.report.judge_camera import fault_of_views
from scripts.shared.infinity import error_at_infinity
from scripts.shared.page import Lines
from scripts.shared.sections import NOT_KEPT, Kept, Record, section
from scripts.shared.simulated import figures, simulated

SIGMA, VIEWS, MODELS = 0.08, (5, 8, 12, 20), ("hybrid", "opencv5")
AT = [math.inf]
HALF = 0.5


def judged(model: str, seed: int, refits: int) -> Record:
    """One calibration, its truth, and the verdicts on it."""
    views, by_hand = VIEWS[seed // 2 % len(VIEWS)], bool(seed % 2)
    case, second = (simulated(seed, views, SIGMA, by_hand, take=take) for take in (0, 1))
    options = CalibrationOptions(model=model)
    try:
        result = calibrate_camera(case.seen, options)
        error = error_at_infinity(result.camera, case.lens)
        truth = figures(result.camera, case.seen, error.pixels, error.errors)
        start = time.process_time()
        check = interval_check(result, AT, simulated_refits(result, options, AT, range(refits)))
        spent = time.process_time() - start
        fault = fault_of_views(result, options)
        found = against_capture(result, second.seen, options, AT)[0]
    except KcalError as refusal:
        return {"refused": str(refusal)}
    return {
        "views": views,
        "truth": truth["everywhere"],
        "share": check.shares[0][0],
        "factor": check.factors[0],
        "true": check.true,
        "fault": None if fault is None else fault.text,
        "same": found.same,
        "probability": found.probability,
        "cpu_s": spent,
    }


def lines(records: list[Record]) -> Lines:
    """One row for each lens model."""
    yield [
        "lens", "calibrations", "truly true", "truth inside, of the image", "refits inside", "refits say true",
        "views say true", "second capture says true", "check agrees", "check with --against agrees",
        "CPU s, 100 refits",
    ]  # fmt: skip
    for model in MODELS:
        some = [one for one in records if one["key"][0] == model and "refused" not in one]
        if not some:
            continue
        true = [one["truth"] > HALF for one in some]
        alone = [one["true"] and one["fault"] is None for one in some]
        both = [ok and one["same"] for ok, one in zip(alone, some, strict=True)]
        agree = [sum(a == b for a, b in zip(said, true, strict=True)) for said in (alone, both)]
        yield [
            "default" if model == MODELS[0] else model,
            len(some),
            sum(true),
            f"{100 * statistics.fmean(one['truth'] for one in some):.0f} %",
            f"{100 * statistics.fmean(one['share'] for one in some):.1f} %",
            sum(one["true"] for one in some),
            sum(one["fault"] is None for one in some),
            sum(bool(one["same"]) for one in some),
            f"{agree[0]} of {len(some)}",
            f"{agree[1]} of {len(some)}",
            f"{statistics.median(one['cpu_s'] / one['key'][2] for one in some) * 100:.0f}",
        ]  # fmt: skip


@section("ordinary.md", "warm refits", count=1, seeds=range(1))
def cold_and_warm(count: int = 8, seeds: range = range(4)) -> Lines:
    """How far refits that begin at the found camera end from those that begin with nothing."""
    yield ["capture", "refits", "apart, σ (median)", "(largest)", "CPU s warm", "CPU s cold"]
    options = CalibrationOptions()
    for seed in [(0, 1, 5, 6)[i] for i in seeds]:
        views, by_hand = VIEWS[seed // 2 % len(VIEWS)], bool(seed % 2)
        result = calibrate_camera(simulated(seed, views, SIGMA, by_hand).seen, options)
        places = result.camera.grid(25, 17).reshape(-1, 2)
        sigma = pixel_covariance(result.camera, places).diagonal(dim1=-2, dim2=-1).sum(-1)
        apart, took = [], [0.0, 0.0]
        for number in range(count):
            drawn, cameras = simulated_capture(result, options, number), []
            for which, warm in enumerate((True, False)):
                start = time.process_time()
                cameras.append(drawn.calibrated(options, warm=warm))
                took[which] += time.process_time() - start
            apart.append(
                float((pixel_errors(cameras[0], cameras[1], places).square().sum(-1) / sigma).nanmean().sqrt())
            )
        kind = f"{views} views {'by hand' if by_hand else 'on a stand'}"
        yield [kind, count, f"{statistics.median(apart):.3f}", f"{max(apart):.3f}",
               *(f"{spent / count:.2f}" for spent in took)]  # fmt: skip


@section("ordinary.md", "intervals", seeds=range(1), refits=2)
def intervals(kept: Kept = NOT_KEPT, seeds: range = range(20), refits: int = 100) -> Lines:
    return lines(kept.records(itertools.product(MODELS, seeds, [refits]), judged))
