"""What stars would give a planned rig, for `kcal budget --stars`."""

from __future__ import annotations

import math

from kcal.cli.console import out, print_table, tell

# Exposures in the table, seconds, and pairs of images.
_EXPOSURES, _PAIRS = (1 / 30, 0.25, 1.0, 4.0, 8.0), 20
_SKIES = {"rural": 20.5, "suburb": 18.0}


def print_star_budget(
    focal: float,
    size: tuple[int, int],
    baseline: float,
    distance: float,
    aperture: float,
    altitude: float,
    clock: float,
) -> None:
    """Print how many stars a lens, an exposure and a sky give, and what range error follows from them.

    Args:
        focal: px.
        size: of the image, px.
        baseline: meters.
        distance: meters, for which range errors are.
        aperture: of the lens, mm.
        altitude: of the middle of the image, degrees.
        clock: sigma of the offset between the cameras' clocks, seconds.
    """
    from kcal.stars.budget import NightPlan, planned_stars

    out.print(
        f"stars: f {focal:g} px, {size[0]}x{size[1]}, aperture {aperture:g} mm, middle of the image {altitude:g}° up, "
        f"clocks ± {clock:g} s; range errors at {distance:g} m from stars and clocks alone (lens and marks come on top)"
    )
    rows = [["sky", "exposure s", "stars", "faintest", "σ px", "trail px", "1 pair", f"{_PAIRS} pairs"]]
    told = []
    for sky, magnitude in _SKIES.items():
        for seconds in _EXPOSURES:
            plan = NightPlan(
                focal_px=focal, size=size, aperture_mm=aperture, seconds=seconds, sky_magnitude=magnitude,
                altitude_deg=altitude,
            )  # fmt: skip
            found = planned_stars(plan)
            shares = [found.range_share(distance, baseline, pairs, clock) for pairs in (1, _PAIRS)]
            some = math.isfinite(found.yaw_sigma)
            rows.append([
                sky, f"{seconds:.3g}", f"{found.stars:.0f}", f"{found.faintest:.1f}" if some else "",
                f"{found.sigma_px:.2f}" if some else "", f"{found.trail_px:.2f}",
                *(f"{100 * share:.2f} %" if some else "" for share in shares),
            ])  # fmt: skip
            told.append({
                "sky_magnitude": magnitude, "seconds": seconds, "stars": found.stars, "trail_px": found.trail_px,
                "range_share": shares if some else None,
            })  # fmt: skip
    tell(stars=told)
    print_table(rows)
    out.print("a photometric model, probably a magnitude too cautious; take an exposure with 20 stars or more")
