"""What `kcal rig` prints of a solved rig."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from kcal.calibrate.rig.result import RigResult
    from kcal.lens.rig import StereoRig

# Items of a source that are named when they are left out; of thousands of matches more are no news.
_MOST_NAMED = 12


def source_lines(result: RigResult) -> list[str]:
    """Residuals by source."""
    from kcal.quantities import length_text

    rows = [["source", "used", "left out", "RMS px", "RMS", "sigmas"]]
    for source in result.sources:
        cells = [
            "" if source.rms_px is None else f"{source.rms_px:.4f}",
            "" if source.rms_m is None else length_text(source.rms_m),
        ]
        sigmas = "" if math.isnan(source.sigmas) else f"{source.sigmas:.2f}"
        rows.append([source.source, f"{source.used}", f"{source.left_out}", *cells, sigmas])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]).rstrip() for row in rows]


def rig_lines(result: RigResult, rig: StereoRig, unpaired: int) -> list[str]:
    """What a result says: residuals by source, the relative pose with its sigmas, the board's squares, the mounting."""
    from kcal.locate.check import triangulated_sides
    from kcal.quantities import length_text, measured_length, measured_text, number_text

    lines = source_lines(result)
    boards, mounting = result.data.boards, rig.mounting
    lines += [
        f"RMS [bold]{result.rms:.4f} px[/] (left {result.rms_px[0]:.4f}, right {result.rms_px[1]:.4f}); "
        f"{result.status.message}",
        f"baseline [bold]{measured_length(float(rig.baseline), result.sigma_baseline)}[/]",
    ]
    if result.exact:
        lines.append(_exact_line(result, rig))
    if boards is not None:
        lines.append(f"{len(result.pairs)} of {len(boards.names)} pairs used, {unpaired} views without partner")
        if result.pairs:
            board = boards.board
            side, spread = triangulated_sides(rig, board.columns, board.rows, result.pixels, board.points)
            true = float((board.points[1] - board.points[0]).norm())
            what = {"checkerboard": "squares", "aprilgrid": "tags"}.get(board.pattern, "distances of circles")
            lines.append(
                f"triangulated {what}: {measured_length(side, spread)}, the board's are {length_text(true, digits=4)}"
            )
    if result.board_warp is not None:
        x, y = (1e3 * result.board_warp).tolist()
        lines.append(f"board warp: {x:+.3f} mm along its rows, {y:+.3f} mm along its columns")
    if mounting is not None and mounting.covariance is not None:
        sigma = mounting.covariance.diagonal().sqrt().tolist()
        place, level = mounting.origin, math.degrees(max(sigma[3:5]))
        heading = measured_text(mounting.heading_deg, math.degrees(sigma[5]))
        pitch, roll = number_text(mounting.pitch_deg, level), number_text(mounting.roll_deg, level)
        lines.append(
            f"left camera at {place.lat:.7f}, {place.lon:.7f}, {number_text(place.height, sigma[2])} m above the "
            f"ellipsoid (± {length_text(max(sigma[:2]), digits=2)} level, {length_text(sigma[2], digits=2)} up), "
            f"heading {heading}°, pitch {pitch}°, roll {roll}°"
        )
        if mounting.refraction is not None and result.data.landmarks is not None:
            lines.append(f"refraction of light {measured_text(mounting.refraction, sigma[6])} of the Earth's curvature")
    return lines


def _exact_line(result: RigResult, rig: StereoRig) -> str:
    """Which cameras were taken as exact, what an error of their lenses does, and which files had no error bars."""
    from kcal.quantities import length_text, number_text

    far, share = 100.0 * float(rig.baseline), 10.0 / float(rig.left.focal.mean())
    text = (
        f"taken as exact, so that errors of these lenses are in no σ: {' and '.join(result.exact)}. An error of 0.1 px "
        f"in one of them is {number_text(100.0 * share, digits=2)} % of a range of {length_text(far, digits=2)}"
    )
    cameras = dict(zip(result.names, result.data.cameras, strict=True))
    known = {name: cameras[name].calibration for name in result.exact}
    bare = [name for name, one in known.items() if one is None or one.covariance is None]
    if not bare:
        return text
    return f"{text}. Without error bars came {' and '.join(bare)}: calibrate with kcal, or import a file that has them"


def print_rig(result: RigResult, lines: list[str]) -> None:
    """Print the lines of a result, and what was turned, left out and should be doubted."""
    from kcal.cli.console import err, out

    for line in lines:
        out.print(line)
    for turned in result.flipped:
        text = f"turned by 180°: {turned.board} ({turned.camera}; the board was read from its other end)"
        out.print(text, markup=False)
    for source in dict.fromkeys(item.source for item in result.left_out):
        gone = [item for item in result.left_out if item.source == source]
        for item in gone[:_MOST_NAMED]:
            err.print("[yellow]left out:[/]", f"{item.label}: {item.reason}")
        if len(gone) > _MOST_NAMED:
            err.print("[yellow]left out:[/]", f"{len(gone) - _MOST_NAMED} more {source}")
    for text in result.warnings:
        err.print("[yellow]warning:[/]", text)
