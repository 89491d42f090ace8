"""Say how differently two lenses see, in words; the picture is in `kcal.report.difference`."""

from __future__ import annotations

import math

from kcal.lens.difference import CameraDifference


def difference_text(found: CameraDifference) -> list[str]:
    """What a comparison of two cameras found, one line each."""
    place = "at infinity" if math.isinf(found.at) else f"at {found.at:g} m"
    lines = [f"difference {place}: RMS {found.rms:.4g} px, largest {found.largest:.4g} px, over the image"]
    lines.append(f"after a turn by {found.turn_deg:.4g}°")
    if not math.isinf(found.at):
        lines[-1] += f" and a shift by {1e3 * float(found.translation.norm()):.3g} mm"
    if found.ratio is None or found.probability is None or found.sigma is None:
        return [*lines, "no error bars in either file: whether this is more than their uncertainty cannot be said"]
    sigma = found.sigma[found.sigma.isfinite()]
    whose = {(True, True): "both cameras", (True, False): "the first camera alone"}.get(
        found.known, "the second camera alone"
    )
    lines.append(
        f"expected from the error bars of {whose}: sigma {float(sigma.median()):.4g} px (median), "
        f"{float(sigma.max()):.4g} px (largest)"
    )
    likely = f"{found.ratio:.2f} times what they predict, as large by chance with probability {found.probability:.2g}"
    verdict = "same within their uncertainty" if found.same else "not the same within their uncertainty"
    return [*lines, f"{verdict}: {likely}"]
