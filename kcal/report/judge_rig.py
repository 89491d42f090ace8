"""The verdict on a rig: its ranges from the covariance of everything together, and whether its pairs agree."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.rig.result import RigResult
from kcal.calibrate.rig.synchrony import Synchrony, synchrony
from kcal.errors import InputError
from kcal.lens.rig import StereoRig
from kcal.locate.range_sigmas import RangeSigmas, range_sigmas
from kcal.report.verdict import Finding, RangeAnswer, Requirement, Verdict, sorted_findings

# Pairs disagree by this many times what noise explains: set on simulated pairs, where synchronous ones reach 1.5.
_APART = 2.5
_LATE_SIGMAS, _LATE = 5.0, 0.02
_MOST_LEFT_OUT = 0.2
# Residuals of a whole rig in their sigmas: more, and something does not fit.
_MOST_VARIANCE = 9.0
_NEXT = {
    "lenses": "take more views of the board with each camera, near the borders of the image, and calibrate again",
    "relative pose": "mark more far features or surveyed landmarks in both images: they determine the relative yaw",
}


def rig_verdict(
    rig: StereoRig,
    requirements: Sequence[Requirement] = (),
    *,
    mark_sigma: float = 0.3,
    result: RigResult | None = None,
    pairs: tuple[Tensor, Tensor] | None = None,
    cameras: Sequence[Verdict] = (),
    subject: str = "rig",
) -> Verdict:
    """Judge a rig against a user's own requirements.

    Args:
        rig: with its covariance.
        requirements: ranges, and how well they must be known.
        mark_sigma: noise of a mark along each axis, px.
        result: as it was solved, for its warnings and its pairs of boards.
        pairs: otherwise, corners of the board (N, 3) in meters, and pixels (P, 2, N, 2) of pairs of views.
        cameras: verdicts on its cameras, whose findings count.
        subject: its name.

    Example:
        >>> import torch
        >>> from kcal.rig import RigCovariance, planned_rig
        >>> rig = planned_rig()
        >>> rig.covariance = RigCovariance.of(rig, pose=torch.diag(torch.tensor([0, 1e-8, 0, 0, 0, 0]).double()))
        >>> verdict = rig_verdict(rig, Requirement.parse("1km:5%, 5km:5%"), mark_sigma=0.1)
        >>> [answer.ok for answer in verdict.answers], verdict.reason
        ([True, False], 'at 5 km the range is known to ±6.8 %; 5 % are required; most of it is from relative pose')
    """
    findings = [finding for verdict in cameras for finding in verdict.findings if finding.severity != "fine"]
    findings += _doubts(rig, result)
    compared = _pairs_compared(rig, result, pairs)
    if compared is not None and compared.pairs:
        findings.append(_synchrony_finding(compared))
    answers = tuple(_rig_answer(rig, requirement, mark_sigma) for requirement in requirements)
    failed = [answer for answer in answers if not answer.ok]
    return Verdict(
        subject=subject,
        answers=answers,
        findings=sorted_findings(findings),
        advice=tuple(dict.fromkeys(_NEXT[a.most] for a in failed if a.most in _NEXT))
        + tuple(text for verdict in cameras for text in verdict.advice),
        basis=f"from the rig's own covariance, where both cameras look, with marks to {mark_sigma:g} px",
        unexplained=max((verdict.unexplained for verdict in cameras), default=0.0),
    )


def _rig_answer(rig: StereoRig, requirement: Requirement, mark_sigma: float) -> RangeAnswer:
    """The worst of several places along the middle row of the left image that both cameras see."""
    width, height = rig.left.size
    worst: RangeSigmas | None = None
    places = [None, *([0.5 * width + share * width, 0.5 * height] for share in (-0.3, 0.3))]
    for place in places:
        try:
            found = range_sigmas(rig, [requirement.distance], pixel_sigma=mark_sigma, pixel=place)
        except InputError:
            if place is None:
                raise
            continue
        if worst is None or not float(found.total) <= float(worst.total):
            worst = found
    assert worst is not None
    parts = {"marks": worst.marks, "lenses": worst.lenses, "relative pose": worst.pose}
    return RangeAnswer(
        requirement=requirement,
        parts={name: float(part) for name, part in parts.items()},
        ranged=bool(worst.ranged),
    )


def _doubts(rig: StereoRig, result: RigResult | None) -> list[Finding]:
    found = []
    if rig.covariance is None:
        found.append(
            Finding(
                name="error-bars",
                severity="stop",
                text="the rig has no error bars: nobody can say how wrong its ranges are",
                action="solve it with kcal rig from cameras that kcal calibrated",
            )
        )
    record = rig.calibration
    if record is not None:
        out = sum(source.left_out for source in record.sources)
        share = out / max(out + sum(source.used for source in record.sources), 1)
        if share > _MOST_LEFT_OUT:
            found.append(
                Finding(
                    name="left-out",
                    severity="stop",
                    text=f"{100 * share:.0f} % of what was seen contradicts the rest and was left out: with so much "
                    "of it nobody can tell which part is right",
                    action="check that both images of each pair were taken at the same moment, and the survey",
                )
            )
        found += [
            Finding(
                name="contradiction",
                severity="stop",
                text=text,
                action="measure again what contradicts, correct it or its sigma, and solve the rig again",
                picture="rig",
            )
            for text in record.contradictions
        ]
    if result is None:
        return found
    if result.exact:
        names = " and ".join(result.exact)
        found.append(
            Finding(
                name="exact-lenses",
                severity="doubt",
                text=f"the lenses of {names} were taken as exact: their errors are in no error bar",
                action="solve the rig from cameras with error bars, with --intrinsics prior",
            )
        )
    if result.variance > _MOST_VARIANCE:
        found.append(
            Finding(
                name="misfit",
                severity="stop",
                text=f"residuals are {math.sqrt(result.variance):.1f} times as large as their sigmas say: cameras, "
                "survey and marks do not fit each other",
                action="look at the residuals by item, and correct what stands out",
                picture="rig",
            )
        )
    found += [Finding(name="rig", severity="doubt", text=text) for text in result.warnings]
    return found


def _pairs_compared(rig: StereoRig, result: RigResult | None, pairs: tuple[Tensor, Tensor] | None) -> Synchrony | None:
    if pairs is not None:
        return synchrony(rig, *pairs)
    boards = None if result is None else result.data.boards
    if result is None or boards is None or boards.pixels.shape[1] != 2:
        return None
    # Turned boards are in the data as they were turned; pairs that were left out count too.
    order = torch.tensor(sorted(range(len(boards.names)), key=lambda i: boards.names[i]), dtype=torch.long)
    return synchrony(rig, boards.points, boards.pixels[order])


def _synchrony_finding(found: Synchrony) -> Finding:
    late = (
        found.delay is not None
        and found.delay_sigma is not None
        and abs(found.delay) > max(_LATE_SIGMAS * found.delay_sigma, _LATE)
    )
    if found.ratio <= _APART and not late:
        return Finding(
            name="synchronization",
            severity="fine",
            text=f"both cameras saw the board in the same place in {found.pairs} pairs "
            f"({found.ratio:.1f} times what noise explains)",
        )
    how = ""
    if late and found.delay is not None and found.delay_sigma is not None:
        which = "after" if found.delay > 0 else "before"
        how = (
            f"; the right camera took its pictures {abs(found.delay):.2f} ± {found.delay_sigma:.2f} steps {which} "
            "the left one"
        )
    return Finding(
        name="synchronization",
        severity="stop" if found.ratio > _APART else "doubt",
        text=f"the board moved between both exposures, or a camera did: it is {1e3 * found.shift:.2g} mm elsewhere for "
        f"the right camera, {found.ratio:.1f} times what noise explains{how}",
        action="trigger both cameras together, or hold the board still in each pose (a tripod), and take pairs again",
        picture="rig",
    )
