"""Make what lies in assets/: boards to print, the demonstration's pictures, a sample rig with marks.

    python -m scripts.make_assets

Everything comes from kcal's own commands: `kcal board` and `kcal demo`.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ASSETS = Path(__file__).resolve().parent.parent / "assets"
BOARDS = (("9x6", "25mm", "A4"), ("7x6", "50mm", "A2"))
FROM_DEMO = {"map.png": "demo-map.png", "rig.json": "sample-rig.json", "points.csv": "sample-points.csv"}


def kcal(*arguments: str) -> None:
    """Run one command of kcal; stop if it fails."""
    subprocess.run([sys.executable, "-c", "from kcal.cli.main import main; main()", *arguments], check=True)


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    boards = ASSETS / "boards"
    boards.mkdir(parents=True, exist_ok=True)
    for size, square, page in BOARDS:
        for suffix in ("pdf", "svg"):
            name = boards / f"board_{size}_{square}_{page}.{suffix}"
            kcal("board", "--board", size, "--square", square, "--paper", page, "-o", str(name))
    with tempfile.TemporaryDirectory() as folder:
        kcal("demo", "-o", folder)
        for source, target in FROM_DEMO.items():
            shutil.copyfile(Path(folder, source), ASSETS / target)
        kcal("demo", "--practice", str(Path(folder, "practice")))
        shutil.copyfile(Path(folder, "practice", "site", "sketch.png"), ASSETS / "practice-site.png")


if __name__ == "__main__":
    main()
