"""Read the target files of Kalibr (https://github.com/ethz-asl/kalibr, wiki page "Calibration targets")."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from kcal.errors import FileError
from kcal.files import read_text
from kcal.strict_yaml import MOST_BYTES, read_yaml


def target_fields(path: str | Path) -> dict[str, Any]:
    r"""The fields of `kcal.corners.board.Board` that a target file of Kalibr describes.

    `aprilgrid` (`tagCols`, `tagRows`, `tagSize`, `tagSpacing`), `checkerboard` (`targetCols`, `targetRows`,
    `rowSpacingMeters`, `colSpacingMeters`) and `circlegrid` (`targetCols`, `targetRows`, `spacingMeters`,
    `asymmetricGrid`). `tagSpacing` is a share of `tagSize`.

    Raises:
        FileError: it cannot be read, or a field is missing or wrong.

    Example:
        >>> import tempfile
        >>> text = "target_type: aprilgrid\ntagCols: 6\ntagRows: 4\ntagSize: 0.08\ntagSpacing: 0.25"
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "april.yaml")
        ...     _ = path.write_text(text)
        ...     target_fields(path)
        {'pattern': 'aprilgrid', 'columns': 12, 'rows': 8, 'square': 0.08, 'gap': 0.02}
    """
    content = read_yaml(read_text(path, MOST_BYTES), str(path))
    if "target_type" not in content:
        raise FileError(f"{path}: not a target file of Kalibr: target_type is missing")
    kind = content["target_type"]

    def number(name: str) -> float:
        value = content.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1e3:
            raise FileError(f"{path}: {name} must be a positive number, it is {value!r:.40}")
        return float(value)

    def count(name: str) -> int:
        value = content.get(name)
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= 500:
            raise FileError(f"{path}: {name} must be a whole number from 1 to 500, it is {value!r:.40}")
        return value

    if kind == "aprilgrid":
        size = number("tagSize")
        columns, rows = 2 * count("tagCols"), 2 * count("tagRows")
        gap = number("tagSpacing") * size
        return {"pattern": "aprilgrid", "columns": columns, "rows": rows, "square": size, "gap": gap}
    if kind not in ("checkerboard", "circlegrid"):
        raise FileError(f"{path}: target_type {kind!r:.40}: kcal reads aprilgrid, checkerboard and circlegrid")
    grid = {"columns": count("targetCols"), "rows": count("targetRows")}
    if kind == "checkerboard":
        across, down = number("colSpacingMeters"), number("rowSpacingMeters")
        if abs(across - down) > 1e-9:
            raise FileError(f"{path}: rowSpacingMeters {down:g} and colSpacingMeters {across:g}: squares are needed")
        return grid | {"square": across}
    asymmetric = content.get("asymmetricGrid")
    if not isinstance(asymmetric, bool):
        raise FileError(f"{path}: asymmetricGrid must be true or false, it is {asymmetric!r:.40}")
    return {"pattern": "asymmetric" if asymmetric else "circles"} | grid | {"square": number("spacingMeters")}
