"""What was found about a calibration: one type, from where a doubt arises to the page that shows it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any, Literal

Severity = Literal["stop", "doubt", "note", "fine"]
SEVERITIES: tuple[Severity, ...] = ("stop", "doubt", "note", "fine")
# The source of what a camera is wrong by beyond its error bars.
FAULTS = "faults of the calibration"
# Of each finding: what people read as its name, the picture that shows it, and the part of range errors that it
# enlarges.
KINDS = {
    "views": ("number of views", "views", "lenses"), "mirrored": ("mirrored board", "coverage", ""),
    "coverage": ("coverage", "coverage", "lenses"), "blur": ("blur", "residuals", "lenses"),
    "patterns": ("patterns in residuals", "residuals", "lenses"), "poses": ("poses", "poses", "lenses"),
    "prediction": ("prediction of other views", "halves", "lenses"), "tilt": ("tilts", "poses", "lenses"),
    "halves": ("check by halves of the views", "halves", "lenses"), "roll": ("rolls", "poses", "lenses"),
    "other-views": ("other views", "", FAULTS), "depth": ("distances", "poses", "lenses"),
    "calibration": ("warning when it was calibrated", "residuals", "lenses"), "board": ("board", "board", "lenses"),
    "changed": ("two cameras", "halves", FAULTS), "names": ("two cameras", "", "lenses"),
    "pupil": ("entrance pupil", "model", "lenses"), "port": ("flat port", "model", "lenses"),
    "model": ("lens model", "model", "lenses"),
    "solver": ("end of the solver", "", "lenses"), "residuals": ("residuals", "residuals", "lenses"),
    "corners": ("corners", "residuals", "lenses"), "open": ("not determined", "", "lenses"),
    "priors": ("priors", "", "lenses"), "center": ("principal point", "", "lenses"),
    "motion": ("motion while an image is read", "", "lenses"), "bending": ("bending of the board", "board", "lenses"),
    "pixels": ("shape of pixels", "", "lenses"), "no-ray": ("part of the image without rays", "coverage", "lenses"),
    "excluded": ("not used", "views", "lenses"), "start": ("focal length for the start", "", "lenses"),
    "copies": ("copies of views", "", "lenses"), "repeated": ("poses that repeat", "poses", "lenses"),
    "moving-lens": ("lens that moves", "", "lenses"), "alone": ("calibrated alone", "", "lenses"),
    "stars": ("boards and stars", "", "lenses"), "unit": ("size of the board", "", FAULTS),
    "units": ("unit of the survey", "rig", FAULTS),
    "error-bars": ("error bars", "", ""), "view": ("common view", "", ""),
    "misfit": ("size of residuals", "rig", "relative pose"), "record": ("no record", "", "relative pose"),
    "synchronization": ("same moment", "rig", "relative pose"), "exact-lenses": ("exact lenses", "", "lenses"),
    "place": ("place of a camera", "rig", "relative pose"), "sigmas": ("sigmas", "rig", "relative pose"),
    "pairs": ("number of pairs", "rig", "relative pose"), "swapped": ("exchanged", "rig", "relative pose"),
    "moved": ("motion of boards", "", "relative pose"),
    "rig": ("warning when it was solved", "", "relative pose"),
    "ranges": ("known ranges", "", "relative pose"),
    "contradiction": ("contradiction", "rig", "relative pose"), "left-out": ("left out", "", "relative pose"),
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Finding:
    """A doubt about a calibration, or a note.

    Args:
        name: short and fixed, for programs: "model", "pupil", "board", "tilt", "coverage", ...
        severity: "stop": the answer is no whatever the error bars say; "doubt": read it; "note": it does no harm that
            was measured; "fine": nothing found.
        text: what was found, and why it matters; one sentence.
        action: what to do; empty where nothing is needed.
        part: the source of range errors that it makes larger; empty: with it, no error bar can be believed. That of its
            name if left out.
        cameras: of a rig, which it is about; empty: of all of it.

    Example:
        >>> found = Finding("tilt", "stop", "the board is never tilted", "tilt it")
        >>> found.sentence, found.title, found.picture, found.part
        ('the board is never tilted; tilt it', 'tilts', 'poses', 'lenses')
    """

    name: str
    severity: Severity
    text: str
    action: str = ""
    part: str | None = None
    cameras: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.part is None:
            object.__setattr__(self, "part", KINDS[self.name][2] if self.name in KINDS else "")

    @property
    def title(self) -> str:
        """What it is about, in words."""
        return KINDS[self.name][0] if self.name in KINDS else self.name

    @property
    def picture(self) -> str:
        """Name of the picture on a page that shows it; empty for none."""
        kind = KINDS[self.name][1] if self.name in KINDS else ""
        return f"{self.cameras[0]}-{kind}" if kind and self.cameras else kind

    @property
    def told(self) -> str:
        """What was found, after the cameras that it is about."""
        return f"{' and '.join(self.cameras)}: {self.text}" if self.cameras else self.text

    @property
    def step(self) -> str:
        """What to do, and for which cameras."""
        return f"{self.action}, for {' and '.join(self.cameras)}" if self.action and self.cameras else self.action

    @property
    def sentence(self) -> str:
        """What was found, and what to do."""
        between = "" if not self.action else ". " if self.action[0].isupper() else "; "
        return f"{self.text}{between}{self.action}"

    def content(self) -> dict[str, Any]:
        """As plain texts, for JSON."""
        return {**dataclasses.asdict(self), "picture": self.picture}


def sentences(findings: Iterable[Finding]) -> tuple[str, ...]:
    """Their sentences, as they are printed."""
    return tuple(one.sentence for one in findings)


def sorted_findings(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The most severe first, but those of the same cameras together, after the most severe of them."""
    found = sorted(findings, key=lambda one: SEVERITIES.index(one.severity))
    whose = list(dict.fromkeys(one.cameras for one in found))
    return tuple(sorted(found, key=lambda one: whose.index(one.cameras)))
