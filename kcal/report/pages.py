"""Pages of one HTML file, without scripts, that fetch nothing: verdicts, and summaries of what was done."""

from __future__ import annotations

import base64
import datetime
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

import kcal
from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.errors import InputError
from kcal.files import read_bytes, write_atomic
from kcal.lens.camera import Camera
from kcal.report.shown import shown_parameters
from kcal.report.verdict import RangeAnswer, Verdict
from kcal.texts import length_text, number_text, page_data, page_policy, range_text, visible

_HERE = Path(__file__).parent
CAPTIONS = {
    "ranges": "Standard deviations of ranges, and what is required.",
    "coverage": "Where corners were seen, with magnified residuals, in the color of the RMS of their view. Empty parts "
    "of the image, its border above all, rest on the lens model alone.",
    "uncertainty": "Standard deviation of where the camera sees far things; it grows where no board was.",
    "residuals": "Residuals of all corners beside a circular Gaussian. Noise is round and without structure.",
    "views": "RMS of each view. A view that stands out is blurred, moved, or has wrong corners.",
    "poses": "How the board was held. Tilts tell the focal length, rolls the principal point, distances the pupil.",
    "halves": "Two cameras from halves of the views: what a wrong model, or a camera that changed, leaves.",
    "model": "The camera beside the hybrid lens fitted to the same views.",
    "board": "The board as the views show it, beside the one that was ordered.",
    "rig": "The site from above, and residuals by source and item.",
}


def verdict_page(
    verdict: Verdict, pictures: Mapping[str, bytes] | None = None, tables: Sequence[Sequence[Sequence[str]]] = ()
) -> str:
    """Make the page as HTML: self-contained, without scripts, and nothing is fetched.

    Args:
        verdict: what it says.
        pictures: PNG data by name, of those in `CAPTIONS`; after a camera's name and a hyphen where there are several.
        tables: rows of cells, the heads first.

    Example:
        >>> page = verdict_page(Verdict(subject="left <camera>"))
        >>> "left &lt;camera&gt;" in page, "YES" in page, "http:" in page
        (True, True, False)
    """
    drawn = dict(pictures or {})
    if any(math.isfinite(answer.sigma) for answer in verdict.answers):
        from kcal.report.positions import range_picture

        drawn = {"ranges": range_picture(verdict.answers), **drawn}
    return from_template(
        "verdict_page",
        style_of("verdict_page"),
        verdict=verdict,
        pictures={name: base64.b64encode(data).decode("ascii") for name, data in drawn.items()},
        captions={name: _caption(name) for name in drawn},
        tables=tables,
        made=f"Made by kcal {kcal.__version__}, {datetime.datetime.now(datetime.UTC):%Y-%m-%d %H:%M} UTC.",
    )


def style_of(name: str) -> str:
    """The style sheet of a page of this folder."""
    return (_HERE / f"{name}.css").read_text(encoding="utf-8")


def from_template(name: str, style: str, scripts: Sequence[str] = (), images: str = "data:", **values: Any) -> str:
    """Fill a template of this folder; markup in values is escaped.

    Args:
        name: of the template.
        style: embedded in the page.
        scripts: likewise; others do not run.
        images: sources of images that the page's policy allows.
        values: what is filled in.
    """
    import jinja2  # loaded here, like matplotlib above: answers without a page do without both

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_HERE), autoescape=True, undefined=jinja2.StrictUndefined, finalize=_visible_text
    )
    environment.filters |= {
        "distance": range_text, "found": _found, "percent": _percent, "sentence": _sentence, "embedded": _embedded,
        "data": page_data,
    }  # fmt: skip
    policy = page_policy(scripts=scripts, styles=[style], images=images)
    return environment.get_template(f"{name}.html").render(values, style=style, scripts=scripts, policy=policy)


def save_verdict_page(
    path: str | Path,
    verdict: Verdict,
    pictures: Mapping[str, bytes] | None = None,
    tables: Sequence[Sequence[Sequence[str]]] = (),
) -> Path:
    """Write a verdict with its pictures and tables as a page (.html), atomically.

    Raises:
        FileError: the file cannot be written.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_verdict_page(Path(folder, "left.html"), Verdict(subject="left")).name
        'left.html'
    """
    return write_atomic(path, verdict_page(verdict, pictures, tables))


def range_rows(verdict: Verdict) -> list[list[str]]:
    """What is required, what was found, and from which source."""
    names = list(verdict.answers[0].parts) if verdict.answers else []
    rows = [["range", "answer", "required σ", "σ", *names]]
    for answer in verdict.answers:
        values = [answer.requirement.meters, answer.sigma, *answer.parts.values()]
        cells = [length_text(value, digits=2) if math.isfinite(value) else "not known" for value in values]
        rows.append([range_text(answer.requirement.distance), "yes" if answer.ok else "no", *cells])
    return rows


def camera_tables(
    camera: Camera, result: CameraCalibrationResult | None = None, name: str = ""
) -> list[list[list[str]]]:
    """Tables of a camera: how it was calibrated, its parameters with σ, the strongest correlations."""
    known = camera.calibration
    record = known.record if known else None
    name = name or (known.name if known else "") or "camera"
    facts = [[name, ""], ["image", f"{camera.size[0]} x {camera.size[1]} px"], ["lens model", f"{camera.model}"]]
    if record is not None:
        facts += [
            ["calibrated", f"{record.created:%Y-%m-%d %H:%M} UTC, kcal {record.kcal_version}"],
            ["views, corners", f"{record.views}, {record.points}; {len(record.excluded)} left out"],
            ["RMS", f"{record.rms:.4f} px"],
            ["noise of a corner", "" if record.noise is None else f"{record.noise:.4f} px along an axis"],
            ["board", f"{record.board}"],
        ]
    if result is not None:
        facts.append(["solver", result.status.message])
    sigma = dict(known.sigma) if known and known.sigma else {}
    rows = [["parameter", "value", "σ"]]
    values = camera.params.detach().tolist()[: shown_parameters(camera.model.hybrid)]
    for name, value in zip(camera.names, values, strict=False):
        own = sigma.get(name)
        rows.append([name, number_text(value, own, digits=6), "" if own is None else number_text(own, own)])
    tables = [facts, rows]
    if known is not None and known.covariance is not None:
        tables.append(_correlations(camera, known.covariance))
    return tables


def _correlations(camera: Camera, covariance: Tensor) -> list[list[str]]:
    names = camera.names[: shown_parameters(camera.model.hybrid)]
    covariance = covariance[: len(names), : len(names)]
    spread = covariance.diagonal().clamp_min(0.0).sqrt()
    rows = (covariance / (spread[:, None] * spread)).tolist()
    found = [(value, names[j], names[i]) for i, row in enumerate(rows) for j, value in enumerate(row[:i])]
    # Parameters that are held, or held equal, say nothing.
    found = sorted((one for one in found if abs(one[0]) < 0.99999), key=lambda one: -abs(one[0]))[:5]
    return [["strongest correlations", ""], *([f"{a}, {b}", f"{value:+.3f}"] for value, a, b in found)]


def _caption(name: str) -> str:
    side, _, kind = name.rpartition("-")
    return f"{side.capitalize()} camera. {CAPTIONS[kind]}" if side else CAPTIONS[kind]


def _visible_text(value: Any) -> Any:
    return visible(value) if type(value) is str else value


def _found(answer: RangeAnswer) -> str:
    if not answer.ranged or not math.isfinite(answer.sigma):
        return "no range can be told"
    return f"±{_percent(100.0 * answer.sigma / answer.requirement.distance)}, {length_text(answer.sigma, digits=2)}"


def _percent(value: float) -> str:
    return f"{value:.0f} %" if value >= 100 else f"{value:.2g} %"


def _sentence(text: str, stop: str = ".") -> str:
    """With a capital and a full stop."""
    return text[:1].upper() + text[1:].rstrip(".") + stop


def save_summary(path: str | Path, name: str, **values: Any) -> Path:
    """Write what a demonstration did and what came out, atomically.

    Args:
        path: of the page.
        name: of the template in this folder.
        values: that it shows.

    Raises:
        FileError: the file cannot be written, or a picture cannot be read.
        InputError: a picture that is neither PNG nor JPEG.
    """
    return write_atomic(path, from_template(name, style_of("summary_page"), **values))


def _embedded(path: str | Path) -> str:
    """A picture file as the address of an image."""
    data = read_bytes(path)
    kinds = {b"\x89PNG": "png", b"\xff\xd8\xff": "jpeg"}
    kind = next((name for start, name in kinds.items() if data.startswith(start)), None)
    if kind is None:
        raise InputError(f"{path}: neither a PNG nor a JPEG picture")
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
