"""`kcal calibrate --model hybrid`: prints how the models compare, and writes the camera that is better."""

from __future__ import annotations

from pathlib import Path

from kcal.cli.console import out, print_table, print_wrote, steps, warn
from kcal.errors import InputError


def calibrate_hybrid_file(
    observations: Path,
    output: Path,
    name: str,
    picture: Path | None,
    *,
    board_warp: bool,
    focal: float | None,
    fov: float | None,
    groups: str,
) -> None:
    """Calibrate, print how the models compare on held-out views, and write the camera and its pictures."""
    from kcal.calibrate.lensfit.hybrid import HybridOptions, calibrate_hybrid
    from kcal.corners.observations import Observations
    from kcal.report.calibration import save_calibration_picture
    from kcal.report.field import save_field_picture

    if groups not in ("blocks", "views"):
        raise InputError(f"--groups {groups}: write blocks or views")
    options = HybridOptions(
        board_warp=board_warp, focal=focal, field_of_view=fov, groups="views" if groups == "views" else "blocks"
    )
    seen = Observations.load(observations)
    with steps("calibrating", len(options.models) + len(options.rivals)) as advance:
        result = calibrate_hybrid(seen, options, advance)
    found = result.calibration
    written = [result.save(output, name=name, source=observations.name)]
    if picture is not None:
        written.append(save_calibration_picture(picture, found))
        if result.kept:
            written.append(save_field_picture(picture.with_suffix(".field.png"), seen, found.camera))

    width, height = seen.image_size
    out.print(f"{len(seen.views)} views, {width}x{height} px; held out in {result.groups} groups, a fifth at a time")
    ranking = sorted(result.held_out.items(), key=lambda entry: entry[1])
    print_table([["model", "held-out RMS, px"], *([model, f"{rms:.4f}"] for model, rms in ranking)])
    out.print(result.reason)
    if result.kept:
        out.print(
            f"hybrid: RMS [bold]{found.rms:.4f} px[/]; the field moves the image by up to {result.largest:.2f} px "
            f"with {result.effective:.0f} effective of {2 * result.units} weights"
        )
    else:
        out.print(f"{found.camera.model}: RMS [bold]{found.rms:.4f} px[/]; {found.status.message}")
    for text in found.warnings:
        warn(text)
    print_wrote(*written)
