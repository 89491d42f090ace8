"""Write one HTML page that explains what was done and what came out; its pictures are embedded."""

from __future__ import annotations

import base64
import dataclasses
from collections.abc import Sequence
from pathlib import Path

from kcal.errors import InputError
from kcal.files import read_bytes, write_atomic
from kcal.texts import page_policy, page_text

_PAGE_STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.55 system-ui, sans-serif; color: #111827; background: #f3f4f6; margin: 0; }
main { max-width: 62rem; margin: 0 auto; padding: 2rem 1.2rem 4rem; }
h1 { font-size: 1.7rem; margin: 0 0 .4rem; }
h2 { font-size: 1.15rem; margin: 0 0 .5rem; }
section { background: #fff; border: 1px solid #e5e7eb; border-radius: 8px; padding: 1.1rem 1.3rem; margin: 1.2rem 0; }
p { margin: .3rem 0 .8rem; max-width: 52rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .92rem; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .7rem; text-align: right; border-bottom: 1px solid #e5e7eb; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
th { color: #4b5563; font-weight: 600; }
figure { margin: .6rem 0; }
figcaption { color: #4b5563; font-size: .88rem; }
img { max-width: 100%; height: auto; }
pre { background: #f3f4f6; padding: .7rem .9rem; white-space: pre-wrap; overflow-wrap: anywhere; font-size: .85rem; }
.row { display: flex; gap: 1rem; flex-wrap: wrap; }
.row figure { flex: 1 1 100%; }
@media (max-width: 44rem) { main { padding: 1rem .6rem; } section { padding: 1rem .8rem; } th, td { padding: .3rem; }
  figure { overflow-x: auto; } figure img { max-width: none; width: 40rem; } }
"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Part:
    """A part of the page: a heading, sentences, and what belongs to them.

    Args:
        heading: its heading.
        text: its paragraphs.
        table: rows of cells, the first row with the heads; empty for no table.
        pictures: PNG or JPEG files with their captions, side by side where there is room.
        code: a command to copy, or "".
    """

    heading: str
    text: tuple[str, ...] = ()
    table: tuple[tuple[str, ...], ...] = ()
    pictures: tuple[tuple[str | Path, str], ...] = ()
    code: str = ""


def summary_page(title: str, lead: str, parts: Sequence[Part]) -> str:
    """Make the page as HTML.

    Args:
        title: its title.
        lead: one paragraph under the title.
        parts: the parts, in order.

    Raises:
        FileError: a picture cannot be read.
        InputError: a picture that is neither PNG nor JPEG, or a table whose rows differ in length.

    Example:
        >>> part = Part(heading="Found", table=(("name", "m"), ("gate", "100")))
        >>> page = summary_page("A rig", "Two cameras.", [part])
        >>> "<td>gate</td><td>100</td>" in page, "http" in page
        (True, False)
    """
    body = "\n".join(_section(part) for part in parts)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<meta HTTP-EQUIV="Content-Security-Policy" content="{page_policy(styles=[_PAGE_STYLE])}">\n'
        f"<title>{page_text(title)}</title>\n<style>{_PAGE_STYLE}</style>\n</head>\n<body>\n<main>\n"
        f"<h1>{page_text(title)}</h1>\n<p>{page_text(lead)}</p>\n{body}\n</main>\n</body>\n</html>\n"
    )


def save_summary(path: str | Path, title: str, lead: str, parts: Sequence[Part]) -> Path:
    """Write the page of `summary_page`, atomically.

    Raises:
        FileError: the file cannot be written, or see `summary_page`.
        InputError: see `summary_page`.
    """
    return write_atomic(path, summary_page(title, lead, parts))


def _section(part: Part) -> str:
    lines = ["<section>", f"<h2>{page_text(part.heading)}</h2>"]
    lines += [f"<p>{page_text(text)}</p>" for text in part.text]
    if part.table:
        lines.append(_html_table(part))
    if part.pictures:
        figures = "\n".join(_figure(path, caption) for path, caption in part.pictures)
        lines.append(f'<div class="row">\n{figures}\n</div>')
    if part.code:
        lines.append(f"<pre>{page_text(part.code)}</pre>")
    return "\n".join([*lines, "</section>"])


def _html_table(part: Part) -> str:
    if len({len(row) for row in part.table}) > 1:
        raise InputError(f"the table of {part.heading!r}: rows of different lengths")
    head, *rows = part.table
    lines = ["<tr>" + "".join(f'<th scope="col">{page_text(cell)}</th>' for cell in head) + "</tr>"]
    lines += ["<tr>" + "".join(f"<td>{page_text(cell)}</td>" for cell in row) + "</tr>" for row in rows]
    return '<div class="scroll" tabindex="0"><table>\n' + "\n".join(lines) + "\n</table></div>"


def _figure(path: str | Path, caption: str) -> str:
    data = read_bytes(path)
    kinds = {b"\x89PNG": "png", b"\xff\xd8\xff": "jpeg"}
    kind = next((name for start, name in kinds.items() if data.startswith(start)), None)
    if kind is None:
        raise InputError(f"{path}: neither a PNG nor a JPEG picture")
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
    text = page_text(caption)
    return f'<figure tabindex="0"><img src="{source}" alt="{text}"><figcaption>{text}</figcaption></figure>'
