"""Pages of the documentation site that follow from the repository: navigation, commands, docstrings, conclusions.

MkDocs calls the functions whose names begin with `on_` (`hooks` in mkdocs.yml). New pages appear without an edit: those
named in `SECTIONS` come first, others of the folder follow by name.
"""

from __future__ import annotations

import base64
import inspect
import json
import re
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scripts.make_reference import DOORS, groups, page_of

if TYPE_CHECKING:  # the tests of the navigation run without MkDocs
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
# Title and folder of each section, and its pages in the order in which they are read.
SECTIONS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("Tutorial", "tutorial", ("guide",)),
    ("Notebooks", "notebooks", ("one-camera", "rig-to-map", "training")),
    (
        "How to",
        "howto",
        ("board", "calibrate", "wide-lenses", "survey", "mark*", "detector", "drift", "exchange*", "other-programs",
         "batches", "gpu"),
    ),
    ("Explanation", "explanation", ("which-lens", "rms", "relative-yaw", "intervals", "camera", "corners", "paper")),
    ("Reference", "reference", ("commands", "warnings", "conventions", "columns")),
    (
        "Measured",
        "measured",
        ("chain", "one-camera", "ordinary", "other-programs", "rig", "locate", "tracks", "marking", "paper", "corners",
         "lens", "solver"),
    ),
)  # fmt: skip
NETWORK_SHIM = "https://unpkg.com/iframe-worker/shim"
OUTSIDE = ("CHANGELOG.md", "CONTRIBUTING.md")  # pages of the repository's root, shown under Reference
PYTHON = {page_of(door).relative_to(DOCS).as_posix(): door for door in DOORS}  # pages of Python names


def ordered(names: list[str], order: tuple[str, ...]) -> list[str]:
    """Names in the order of the first pattern that each matches; the others behind, by name."""
    return sorted(names, key=lambda name: ([fnmatch(name, pattern) for pattern in (*order, "*")].index(True), name))


def navigation() -> list[Any]:
    """Every page of docs/ and every generated one, by section."""
    nav: list[Any] = [{"Home": "index.md"}]
    for title, folder, order in SECTIONS:
        names = [page.relative_to(DOCS / folder).with_suffix("").as_posix() for page in (DOCS / folder).rglob("*.md")]
        pages: list[Any] = [f"{folder}/{name}.md" for name in ordered([*names, *_generated(folder)], order)]
        if folder == "measured":
            pages.insert(0, "measured/index.md")
        if folder == "reference":
            pages = [page for page in pages if page not in PYTHON]
            pages += [{"Python": list(PYTHON)}]
            pages += ["architecture.md", *(f"reference/{name.lower()}" for name in OUTSIDE)]
        nav.append({title: pages})
    return nav


def _generated(folder: str) -> list[str]:
    notebooks = [path.stem for path in (DOCS / folder).glob("*.ipynb")]
    return [*notebooks, "commands"] if folder == "reference" else notebooks


def with_descriptions(door: str, markdown: str) -> str:
    """A page of names with each linked to its docstring, which follows as mkdocstrings' directive."""
    lines = []
    for title, names in groups(door).items():
        for name, module in names:
            markdown = markdown.replace(f"| `{name}` ", f"| [`{name}`][{module}.{name}] ")
        lines += [f"## {title}: descriptions", "", *(f"::: {module}.{name}\n" for name, module in names)]
    return "\n".join([markdown, *lines])


def commands_page() -> str:
    """Every command with its description and options, from the command line itself."""
    from typer.main import get_command

    from kcal.cli.main import app

    def walk(command: Any, words: tuple[str, ...]) -> Iterator[str]:
        yield f"## {' '.join(words)}\n" if words[1:] else "# Commands\n"
        yield f"{inspect.cleandoc(command.help or '')}\n"
        if hasattr(command, "commands"):
            for name, found in command.commands.items():
                # The first command of `kcal rig` and its like runs where none is named.
                implied = words[1:] and name == next(iter(command.commands))
                yield from walk(found, words if implied else (*words, name))
            return
        yield "| Option | Meaning | Default |\n|---|---|---|"
        for option in command.params:
            if option.name != "help":
                yield _option_row(option)
        yield ""

    return "\n".join(walk(get_command(app), ("kcal",)))


def _option_row(option: Any) -> str:
    names = ", ".join(f"`{name}`" for name in sorted(option.opts, key=len, reverse=True) if name.startswith("-"))
    kind = str(getattr(option.type_descriptor.annotation, "__name__", "")).upper()
    value = "" if getattr(option, "is_flag", False) else f" `{option.metavar or kind}`"
    shown = f"{names}{value}" if names else f"`{option.metavar or option.name}`"
    default = "required" if option.required else getattr(option.default, "value", option.default)
    plain = "" if default is None or default is False or callable(default) else str(default)
    cells = (shown, option.help or "", plain)
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


def conclusions_page() -> str:
    """What to conclude from each measured page."""
    about = "Scripts of the repository write each page, which ends with what they need. Losses and conclusions:"
    lines = ["# Measured", "", about, ""]
    _, folder, order = SECTIONS[-1]
    for name in ordered([page.stem for page in (DOCS / folder).glob("*.md")], order):
        title, *opening = (DOCS / folder / f"{name}.md").read_text(encoding="utf-8").split("\n\n")[:3]
        lines += [f"## [{title.removeprefix('# ')}]({name}.md)", "", "\n\n".join(opening), ""]
    return "\n".join(lines)


def notebook_page(path: Path) -> tuple[str, dict[str, bytes]]:
    """A notebook with its stored outputs as a page, and the pictures of that page by name."""
    pictures: dict[str, bytes] = {}

    def picture(data: str) -> str:
        name = f"{path.stem}-{len(pictures) + 1}.png"
        pictures[name] = base64.b64decode(data)
        return name

    parts = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", ()):
            shown = {kind: "".join(text) for kind, text in output.get("data", {"text": output.get("text")}).items()}
            if html := shown.get("text/html"):
                html = re.sub(r"data:image/png;base64,([\w+/=]+)", lambda found: picture(found[1]), html)
                parts.append(f'<div class="output">{html}</div>')
            elif "image/png" in shown:
                parts.append(f"![Output of the cell above]({picture(shown['image/png'])})")
            else:
                parts.append(f"```text\n{shown.get('text/plain', shown.get('text'))}\n```")
    parts.insert(1, f'<a href="{path.name}" download>This page as a notebook</a>')
    return "\n\n".join(parts), pictures


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    config.nav = navigation()
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    from mkdocs.structure.files import File

    pages = {"reference/commands.md": commands_page(), "measured/index.md": conclusions_page()}
    pages |= {f"reference/{name.lower()}": (ROOT / name).read_text(encoding="utf-8") for name in OUTSIDE}
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    for path in sorted(DOCS.glob("notebooks/*.ipynb")):
        page, pictures = notebook_page(path)
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=page))
        for name, data in pictures.items():
            files.append(File.generated(config, f"notebooks/{name}", content=data))
    for path in sorted((ROOT / "assets").rglob("*.*")):
        name = path.relative_to(ROOT).as_posix()
        files.append(File.generated(config, name, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Links that leave docs/ in the repository stay inside the site."""
    if page.is_homepage:
        page.meta["hide"] = ["navigation", "toc"]  # the picture gets their place
    if page.file.src_uri in PYTHON or page.file.src_uri.startswith("reference/changelog"):
        page.meta["search"] = {"boost": 0.3}  # what explains is found before what lists
    if page.file.src_uri == "howto/opencv.md":
        page.meta["search"] = {"boost": 2}  # K and D are OpenCV's before they are the beginning of a word
    if page.file.src_uri in PYTHON:
        return with_descriptions(PYTHON[page.file.src_uri], markdown)
    if page.file.src_uri in {f"reference/{name.lower()}" for name in OUTSIDE}:
        return re.sub(r"\]\(docs/", "](../", markdown)
    markdown = re.sub(r"(\]\([\w/.-]+)\.ipynb\)", r"\1.md)", markdown)
    up = "../" * page.file.src_uri.count("/")
    return re.sub(rf"\]\({re.escape(up)}\.\./(?=assets/)", f"]({up}", markdown)


def on_page_content(html: str, **_: Any) -> str:
    """A click on a picture shows it at its full size; the empty corner of a table is no heading."""
    html = re.sub(r"<th([^>]*)></th>", r"<td\1></td>", html)
    return re.sub(r'<img [^>]*src="([^"]+)"[^>]*>', r'<a href="\1">\g<0></a>', html)


def on_post_build(config: MkDocsConfig) -> None:
    """What the theme lacks: searching without a server and without the network, and a name for the search."""
    site = Path(config.site_dir)
    for path in site.rglob("*.html"):
        up = "../" * (len(path.relative_to(site).parts) - 1)
        text = path.read_text(encoding="utf-8").replace(NETWORK_SHIM, f"{up}offline-search.js")
        text = text.replace('role="dialog"', 'role="dialog" aria-label="Search"')
        path.write_text(text, encoding="utf-8")
