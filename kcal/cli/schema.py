"""`kcal schema`: the JSON schema of each of kcal's own files."""

from __future__ import annotations

import importlib
from typing import Annotated, Any

import orjson
import typer

from kcal.cli.console import out, print_table, tell
from kcal.errors import InputError

# Kind, class, and which command writes it.
FILES = {
    "camera": ("kcal.io.camera_file", "CameraFile", "kcal calibrate"),
    "rig": ("kcal.io.rig_file", "RigFile", "kcal rig"),
    "camera-rig": ("kcal.io.rig_file", "CameraRigFile", "kcal rig of three cameras and more, kcal station"),
    "observations": ("kcal.corners.observations", "Observations", "kcal detect"),
    "board": ("kcal.calibrate.hybrid.measured_board", "BoardFile", "kcal board measure"),
}


def file_schema(kind: str) -> dict[str, Any]:
    """The schema (JSON Schema 2020-12) of a kind of file, with the version that this kcal writes.

    Example:
        >>> schema = file_schema("camera")
        >>> schema["properties"]["kcal"], schema["required"][:3]
        ({'const': 'camera'}, ['kcal', 'version', 'name'])
    """
    module, name, _ = FILES[kind]
    file = getattr(importlib.import_module(module), name)
    schema = file.model_json_schema(mode="serialization")
    schema["properties"] = {
        "kcal": {"const": file.KIND},
        "version": {"const": file.VERSION},
        **schema["properties"],
    }
    # All fields of the version's first files are written, so that a reader need not know their defaults.
    schema["required"] = [name for name in schema["properties"] if name not in file._LATER]
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"kcal {file.KIND} file, version {file.VERSION}",
        **{key: value for key, value in schema.items() if key != "title"},
    }


def schema_command(
    kind: Annotated[
        str | None,
        typer.Argument(
            metavar="KIND", help="camera, rig, camera-rig, observations or board; a list of them if not given."
        ),
    ] = None,
) -> None:
    """Print the JSON schema of a kind of file, for programs that read or check kcal's files.

    What a schema cannot say (that a covariance is one, or that names fit the model) is checked when kcal reads a file.

    **Example**

    `kcal schema camera > camera.schema.json`
    """
    if kind is None:
        print_table([["kind", "written by"], *([name, writer] for name, (*_, writer) in FILES.items())], left=(0, 1))
        return
    if kind not in FILES:
        raise InputError(f"kcal schema: no kind of file is called {kind!r}; kinds: {', '.join(FILES)}")
    tell(schema=file_schema(kind))
    out.print(orjson.dumps(file_schema(kind), option=orjson.OPT_INDENT_2).decode(), markup=False)
