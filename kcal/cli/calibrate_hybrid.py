"""`kcal calibrate --model hybrid`: the evidence on the screen, the winner in the file."""

from __future__ import annotations

from pathlib import Path


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
    from rich.table import Table

    from kcal.calibrate.lensfit.hybrid import HybridOptions, calibrate_hybrid
    from kcal.cli.calibrate import record
    from kcal.cli.console import err, out, steps
    from kcal.corners.observations import Observations
    from kcal.errors import InputError

    if groups not in ("blocks", "views"):
        raise InputError(f"--groups {groups!r}: blocks or views")
    options = HybridOptions(
        board_warp=board_warp, focal=focal, field_of_view=fov, groups="views" if groups == "views" else "blocks"
    )
    seen = Observations.load(observations)
    with steps("calibrating", len(options.models) + len(options.rivals)) as advance:
        result = calibrate_hybrid(seen, options, advance)
    found = result.calibration
    record(found, seen, name or observations.name.split(".")[0], observations.name).save(output)
    written = [output]
    if picture is not None:
        from kcal.report.calibration import save_calibration_picture

        written.append(save_calibration_picture(picture, seen, found))
        if result.kept:
            from kcal.report.field import save_field_picture

            written.append(save_field_picture(picture.with_suffix(".field.png"), seen, found.camera))

    width, height = seen.image_size
    out.print(f"{len(seen.views)} views, {width}x{height} px; held out in {result.groups} groups, a fifth at a time")
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("model", no_wrap=True)
    table.add_column("held-out RMS, px", justify="right", no_wrap=True)
    for model, rms in sorted(result.held_out.items(), key=lambda entry: entry[1]):
        table.add_row(model, f"{rms:.4f}")
    out.print(table)
    out.print(result.reason)
    if result.kept:
        out.print(
            f"hybrid: RMS [bold]{found.rms:.4f} px[/]; the field moves the image by up to {result.largest:.2f} px "
            f"with {result.effective:.0f} effective of {2 * result.units} weights"
        )
    else:
        out.print(f"{found.camera.model}: RMS [bold]{found.rms:.4f} px[/]; {found.status.message}")
    for text in found.warnings:
        err.print("[yellow]warning:[/]", text, markup=True)
    for path in written:
        out.print(f"wrote {path}", markup=False)
