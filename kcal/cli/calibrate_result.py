"""What `kcal calibrate` tells of a calibration: to persons, and to programs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from kcal.cli.console import out, print_table, warn
from kcal.quantities import measured_text, number_text

if TYPE_CHECKING:
    from kcal.calibrate.camera.result import CameraCalibrationResult


def print_calibration(result: CameraCalibrationResult, *, reject: bool, verbose: bool) -> None:
    """Print what a person reads: noise, uncertainty, parameters, board, warnings, what to photograph next."""
    from kcal.calibrate.camera.summary import distances_text, summarize

    assert result.camera.calibration is not None
    record = result.camera.calibration.record
    assert record is not None
    width, height = result.observations.image_size
    out.print(f"{record.views} views, {record.points} corners, {width}x{height} px, model {result.camera.model}")
    out.print(distances_text(result))
    # Warnings explain the others.
    ended = "converged" if result.status.name == "CONVERGED" else result.status.message
    fitted = f"; noise {result.noise:.4f} px along an axis; {ended} ({result.iterations} steps)"
    out.print(f"RMS [bold]{result.rms:.4f} px[/]{fitted}")
    brief = summarize(result)
    if brief.worst == brief.worst:
        center, border, worst = (number_text(one, digits=2) for one in (brief.center, brief.border, brief.worst))
        out.print(
            f"far directions: ± {center} px in the middle of the image, "
            f"{border} px at its border, {worst} px at worst; no board reached {100 * brief.unreached:.0f} % of it"
        )
    if result.hybrid is not None:
        (cx, cy), (sx, sy) = result.camera.center.tolist(), (result.sigma[name] for name in ("cx", "cy"))
        out.print(f"focal length {brief.focal}; principal point {measured_text(cx, sx)}, {measured_text(cy, sy, 'px')}")
    if brief.pupil is not None and brief.pupil_sigma is not None:
        pupil = measured_text(1e3 * brief.pupil, 1e3 * brief.pupil_sigma, "mm", sign=True)
        out.print(f"entrance pupil: {pupil} at the image's corner")
    if (board := result.measured_board) is not None and bool(board.amplitudes.any()):
        (bend, bend_s), (wide, wide_s), (skew, skew_s), (rest, rest_s) = (
            board.bending, board.stretch, board.shear, board.print_error,
        )  # fmt: skip
        out.print(
            f"board: bends by {measured_text(1e3 * bend, 1e3 * bend_s, 'mm')}; "
            f"stretch {measured_text(100 * wide, 100 * wide_s, '%', sign=True)}, "
            f"shear {measured_text(100 * skew, 100 * skew_s, '%', sign=True)}, "
            f"print {measured_text(1e3 * rest, 1e3 * rest_s, 'mm')}"
        )
    if verbose:
        print_table([["parameter", "value", "± σ"], *_parameters(result)])
    if result.board_warp is not None:
        x, y = (1e3 * result.board_warp).tolist()
        out.print(f"board warp: {x:+.3f} mm along its rows, {y:+.3f} mm along its columns")
    if reject:
        out.print(f"left out: {100 * result.rejected_share:.2f} % of the corners")
    for entry in result.excluded:
        out.print(f"  {entry.name}: {entry.reason}", markup=False)
    for text in result.warnings:
        warn(text)
    for text in result.advice:
        out.print(f"next: {text}", markup=False)


def calibration_numbers(result: CameraCalibrationResult) -> dict[str, Any]:
    """What programs want to know of a calibration."""
    from kcal.calibrate.camera.summary import summarize

    brief = summarize(result)
    return dict(
        rms_px=result.rms,
        noise_px=result.noise,
        views=int(result.per_view_rms.isfinite().sum()),
        corners=int(result.residuals[..., 0].isfinite().sum()),
        model=str(result.camera.model),
        converged=result.status.name,
        sigma_px={"center": brief.center, "border": brief.border, "worst": brief.worst},
        unreached=brief.unreached,
        focal_px=None if brief.focal is None else brief.focal.value.tolist(),
        focal_sigma_px=None if brief.focal is None else _without_nan(brief.focal.sigma.tolist()),
        parameters=dict(zip(result.camera.names, result.camera.params.tolist(), strict=True)),
        sigma=result.sigma,
        advice=result.advice,
    )


def _without_nan(values: list[float]) -> list[float | None]:
    """As JSON has them: None for NaN."""
    return [value if value == value else None for value in values]


def _parameters(result: CameraCalibrationResult) -> list[list[str]]:
    """Name, value and σ of each parameter."""
    rows = []
    values = dict(zip(result.camera.names, result.camera.params.tolist(), strict=True))
    for name, sigma in result.sigma.items():
        unknown = "fixed" if name in result.fixed else "not determined"
        spread = unknown if sigma is None else number_text(sigma, sigma)
        if name in result.led_by_prior:
            spread += " (by its prior)"
        rows.append([name, number_text(values[name], sigma, digits=6), spread])
    return rows
