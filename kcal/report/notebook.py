"""What notebooks show of cameras, rigs, results, corners, positions and verdicts: as the command line does."""

from __future__ import annotations

import base64
import dataclasses
from collections.abc import Iterable
from functools import singledispatch

import numpy as np
from matplotlib.figure import Figure

from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.calibrate.rig.result import RigResult
from kcal.corners.observations import Observations
from kcal.lens.camera import Camera
from kcal.lens.rig import Rig
from kcal.locate.positions import Located
from kcal.report.calibration import calibration_figure, coverage_figure
from kcal.report.figures import picture_bytes
from kcal.report.positions import positions_figure, stations_figure
from kcal.report.rig import rig_figure
from kcal.report.shown import camera_blocks, derived_camera, observations_blocks, rig_blocks
from kcal.report.tables import position_rows
from kcal.report.verdict import Verdict
from kcal.texts import page_text

# Positions that a notebook shows one by one.
_MOST = 40


@singledispatch
def html_of(record: object) -> str | None:
    """A picture, tables and lines as HTML, every text of it escaped; None where its `repr` tells more.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480))
        >>> html_of(camera)[:40]
        '<p>camera<br>640x480 px, opencv5, valid '
    """
    return None


@html_of.register
def _camera_html(camera: Camera) -> str | None:
    plain = camera.params.ndim == 1 and not camera.params.is_meta
    return _html_of_blocks(camera_blocks(*derived_camera(camera))) if plain else None


@html_of.register
def _rig(rig: Rig) -> str | None:
    return None if rig.rotation.is_meta else _html_of_blocks(rig_blocks(rig))


@html_of.register
def _calibration(result: CameraCalibrationResult) -> str:
    advice = (f"next: {text}" for text in result.advice)
    return _picture_html(calibration_figure(result)) + _html_of_blocks([*result.warnings, *advice])


@html_of.register
def _solved_rig(result: RigResult) -> str:
    return _picture_html(rig_figure(result)) + _html_of_blocks(result.warnings)


@html_of.register
def _observations(seen: Observations) -> str:
    return (_picture_html(coverage_figure(seen)) if seen.views else "") + _html_of_blocks(observations_blocks(seen))


@html_of.register
def _located(located: Located) -> str:
    count = len(located.columns.names)
    if count > _MOST:
        some = np.linspace(0, count - 1, _MOST).round().astype(int)
        located = dataclasses.replace(located, columns=located.columns.rows(some), rows=located.rows or count)
    reasons = [f"* {position.name}: {position.reason}" for position in located.positions if position.reason]
    note = f"Interval: {located.interval_note}. Positions are {located.frame}."
    table = _html_of_blocks([located.count_note, position_rows(located), *reasons, note])
    if located.origin is None:
        return table
    return _picture_html((positions_figure if located.centers is None else stations_figure)(located)) + table


@html_of.register
def _verdict(verdict: Verdict) -> str:
    return f'<pre style="white-space: pre-wrap">{page_text(chr(10).join(verdict.lines()))}</pre>'


def _picture_html(figure: Figure) -> str:
    data = base64.b64encode(picture_bytes(figure)).decode()
    return f'<img alt="" style="max-width: 100%" src="data:image/png;base64,{data}">'


def _html_of_blocks(blocks: Iterable[str | list[list[str]]]) -> str:
    """Lines as a paragraph, rows as a table whose head is the first."""
    parts, lines = [], list[str]()
    for block in [*blocks, []]:
        if lines and (not isinstance(block, str) or block.startswith("\n")):
            parts.append(f"<p>{'<br>'.join(lines)}</p>")
            lines = []
        if isinstance(block, str):
            lines.append(page_text(block.strip()))
        elif block:
            rows = zip(["th", *["td"] * (len(block) - 1)], block, strict=True)
            cells = ("".join(f"<{tag}>{page_text(cell)}</{tag}>" for cell in row) for tag, row in rows)
            parts.append(f"<table>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>")
    return "".join(parts)
