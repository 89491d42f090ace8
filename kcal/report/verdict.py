"""The verdict on a camera or a rig: may it be used to this range, why not, and what to photograph next."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from kcal.doors import shown_in_notebooks
from kcal.finding import FAULTS, Finding, sorted_findings
from kcal.locate.stereo import BEARING_SIGMAS
from kcal.texts import brief, counted_text, range_text
from kcal.values import ranges_and_errors

# What lessens each source, where no finding tells more.
_NEXT = {
    "marks": "mark targets more accurately, or use a longer baseline or focal length: no calibration mends this",
    "lenses": "take more views of the board, near the borders of the image too, and calibrate again",
    "relative pose": "mark more far features or surveyed landmarks in both images: they determine the relative yaw",
    FAULTS: "look at the doubts below, and calibrate again without them",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Requirement:
    """How well a range must be known: its standard deviation at a distance.

    Args:
        distance: of the target, meters.
        meters: largest standard deviation of its range, meters.

    Example:
        >>> Requirement.parse("5km:10%, 800m:20m")
        (Requirement(distance=5000.0, meters=500.0), Requirement(distance=800.0, meters=20.0))
    """

    distance: float
    meters: float

    @classmethod
    def parse(cls, text: str) -> tuple[Requirement, ...]:
        """Read `RANGE:SHARE%` or `RANGE:METERS`, several with commas.

        Raises:
            InputError: something else, or a number that is not positive.
        """
        return tuple(cls(distance=far, meters=most) for far, most in ranges_and_errors(text, "requirement"))


@dataclasses.dataclass(frozen=True, kw_only=True)
class RangeAnswer:
    """Yes or no to one requirement.

    Args:
        requirement: what was asked.
        parts: source -> standard deviation of the range from it, meters; infinite where nothing is known of it.
    """

    requirement: Requirement
    parts: Mapping[str, float]

    @property
    def sigma(self) -> float:
        """Standard deviation of the range, meters."""
        return math.hypot(*self.parts.values())

    @property
    def ranged(self) -> bool:
        """Whether a range can be told at all there: the parallax is three of its sigmas."""
        return self.sigma * BEARING_SIGMAS <= self.requirement.distance

    @property
    def ok(self) -> bool:
        """Whether the requirement is met."""
        return self.ranged and self.sigma <= self.requirement.meters

    def fails_by(self, source: str) -> bool:
        """Whether the requirement is missed, and this source is most of the error or alone makes the difference."""
        rest = {name: part for name, part in self.parts.items() if name != source}
        return not self.ok and (self.most == source or dataclasses.replace(self, parts=rest).ok)

    @property
    def most(self) -> str:
        """The source of most of the error."""
        return max(self.parts, key=lambda name: self.parts[name])

    @property
    def text(self) -> str:
        """One sentence."""
        far, asked = range_text(self.requirement.distance), self._share(self.requirement.meters)
        if not self.ranged or not math.isfinite(self.sigma):
            return f"at {far} no range can be told; {asked} are required"
        return f"at {far} the range is known to ±{self._share(self.sigma)}; {asked} are required"

    def _share(self, meters: float) -> str:
        share = 100.0 * meters / self.requirement.distance
        return f"{share:.0f} %" if share >= 100 else f"{share:.2g} %"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verdict:
    """May this camera or rig be used, and why not.

    Args:
        subject: what is judged.
        answers: to each requirement.
        findings: the most severe first.
        advice: what to photograph or measure next, the most useful first.
        basis: how ranges were computed; one sentence.
        unexplained: px RMS over the image by which a camera is wrong beyond its error bars, as far as that was seen.

    Example:
        >>> need = Requirement(distance=1000.0, meters=50.0)
        >>> verdict = Verdict(subject="left", answers=(RangeAnswer(requirement=need, parts={"lenses": 20.0}),))
        >>> verdict.usable, verdict.reason
        (True, 'at 1 km the range is known to ±2 %; 5 % are required')
    """

    __repr__ = brief
    _repr_html_ = shown_in_notebooks

    subject: str
    answers: tuple[RangeAnswer, ...] = ()
    findings: tuple[Finding, ...] = ()
    advice: tuple[str, ...] = ()
    basis: str = ""
    unexplained: float = 0.0

    @property
    def stops(self) -> tuple[Finding, ...]:
        """The findings for which the answer is no."""
        return tuple(finding for finding in self.findings if finding.severity == "stop")

    @property
    def usable(self) -> bool:
        """Yes to everything that was required, and nothing that forbids the use."""
        return not self.stops and all(answer.ok for answer in self.answers)

    @property
    def but(self) -> str:
        """What stands beside a yes: how many doubts there are; empty for none."""
        doubts = sum(finding.severity == "doubt" for finding in self.findings)
        return f"with {counted_text(doubts, 'doubt')}" if doubts and self.usable else ""

    @property
    def groups(self) -> list[tuple[tuple[str, ...], list[Finding]]]:
        """The findings about the same cameras together; no camera stands for all of the subject."""
        grouped = itertools.groupby(self.findings, lambda finding: finding.cameras)
        return [(cameras, list(findings)) for cameras, findings in grouped]

    @property
    def reason(self) -> str:
        """The one reason: the largest contribution to what misses a requirement, else what forbids the use."""
        named, worst = self._forbidding, self._worst
        if named is not None and (worst is None or named.part in ("", FAULTS)):
            return named.told
        if worst is not None:
            return f"{worst.text}; most of it is from {worst.most}" + (f": {named.told}" if named else "")
        if self.answers:
            return max(self.answers, key=lambda answer: answer.sigma / answer.requirement.meters).text
        return "nothing was found that forbids its use; no range was required"

    @property
    def next_step(self) -> str:
        """What to photograph or do next to mend the reason of the answer; empty if nothing is needed."""
        named, worst = self._forbidding, self._worst
        if named is not None and named.action:
            return named.step
        if worst is None:
            return "nothing is needed" if self.usable else _NEXT["lenses"]
        return self._against(worst.most)

    @property
    def improvement(self) -> str:
        """What would make ranges better known where they are known well enough: against most of their error."""
        if not self.answers:
            return self.advice[0] if self.advice else "nothing is needed"
        return self._against(max(self.answers, key=lambda answer: answer.sigma / answer.requirement.meters).most)

    def _against(self, source: str) -> str:
        if source == "lenses" and self.advice:
            return self.advice[0]
        return _NEXT.get(source, _NEXT["lenses"])

    @property
    def _worst(self) -> RangeAnswer | None:
        """The answer that misses its requirement by most."""
        failed = [answer for answer in self.answers if not answer.ok]
        return max(failed, key=lambda answer: answer.sigma / answer.requirement.meters, default=None)

    @property
    def _forbidding(self) -> Finding | None:
        """What forbids the use: error bars that cannot be believed, else the cause of the worst answer's error."""
        worst = self._worst
        without_worth = [finding for finding in self.stops if not finding.part]
        if without_worth or worst is None:
            return next(iter([*without_worth, *self.stops]), None)
        return next((finding for finding in self.stops if finding.part == worst.most), None)

    def lines(self, told: Iterable[Finding] = ()) -> list[str]:
        """Findings but those that were `told` already, ranges, and last the answer, its reason and the next step."""
        # What is the reason is said there.
        known = {finding.text for finding in told} | {one.text for one in self.stops if one.told == self.reason}
        lines = []
        for cameras, findings in self.groups:
            news = [f"  {one.title}: {one.sentence}" for one in findings
                    if one.severity != "fine" and one.text not in known]  # fmt: skip
            lines += [f"{' and '.join(cameras)}:" if cameras else "found:", *news] if news else []
        if self.answers:
            lines.append(f"ranges {self.basis}:")
        # A single answer is the reason, and said once.
        if [answer.text for answer in self.answers] != [self.reason]:
            lines += [f"  {'met' if answer.ok else 'missed'}: {answer.text}" for answer in self.answers]
        lines.append(f"{'YES' if self.usable else 'NO'}{self.but and f', {self.but}'}: {self.reason}")
        return lines if self.usable else [*lines, f"next: {self.next_step}"]

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain numbers and texts, for JSON; a range that cannot be told has no sigma."""
        return {
            "subject": self.subject,
            "usable": self.usable,
            "doubts": sum(finding.severity == "doubt" for finding in self.findings),
            "reason": self.reason,
            "next": self.next_step,
            "ranges": [
                {
                    "distance_m": answer.requirement.distance,
                    "required_m": answer.requirement.meters,
                    "sigma_m": answer.sigma if answer.ranged and math.isfinite(answer.sigma) else None,
                    "ok": answer.ok,
                    "parts_m": {name: v if math.isfinite(v) else None for name, v in answer.parts.items()},
                }
                for answer in self.answers
            ],
            "findings": [finding.content() for finding in self.findings],
            "advice": list(self.advice),
            "basis": self.basis,
            "unexplained_px": self.unexplained,
        }


def weighed_findings(
    findings: Sequence[Finding], answers: Sequence[RangeAnswer], *, wrong: bool = False
) -> tuple[Finding, ...]:
    """Sorted findings, where a fault that the requirements bear is a doubt, and one that breaks them is the reason.

    Without requirements, one that makes the camera `wrong` by more than its error bars is.
    """
    breaks = any(answer.fails_by(FAULTS) for answer in answers) or (wrong and not answers)
    worse = [breaks and one.part == FAULTS and one.severity == "doubt" for one in findings]
    both = zip(findings, worse, strict=True)
    return sorted_findings(dataclasses.replace(one, severity="stop") if bad else one for one, bad in both)
