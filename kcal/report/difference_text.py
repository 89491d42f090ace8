"""Say how differently two lenses see, in words; the picture is in `kcal.report.difference`."""

from __future__ import annotations

import math

from kcal.lens.difference import CameraDifference
from kcal.texts import length_text, number_text, range_text


def difference_text(found: CameraDifference) -> list[str]:
    """What a comparison of two cameras found, one line each."""
    place = "at infinity" if math.isinf(found.at) else f"at {range_text(found.at)}"
    spread = None if found.sigma is None else found.sigma[found.sigma.isfinite()]
    typical = None if spread is None else float(spread.median())
    rms, largest = (number_text(value, typical) for value in (found.rms, found.largest))
    lines = [f"difference {place}: RMS {rms} px, largest {largest} px, over the image"]
    lines.append(f"after a turn by {number_text(found.turn_deg)}°")
    if not math.isinf(found.at):
        lines[-1] += f" and a shift by {length_text(float(found.translation.norm()))}"
    if found.ratio is None or found.probability is None or spread is None or typical is None:
        return [*lines, "no error bars in either file: whether this is more than their uncertainty cannot be said"]
    whose = {(True, True): "both cameras", (True, False): "the first camera alone"}.get(
        found.known, "the second camera alone"
    )
    lines.append(
        f"expected from the error bars of {whose}: sigma {number_text(typical, typical)} px (median), "
        f"{number_text(float(spread.max()), digits=2)} px (largest)"
    )
    likely = (
        f"{number_text(found.ratio)} times what they predict, as large by chance with probability "
        f"{number_text(found.probability, digits=2)}"
    )
    verdict = "same within their uncertainty" if found.same else "not the same within their uncertainty"
    return [*lines, f"{verdict}: {likely}"]
