"""Carry out the Containerfile's steps without a container: in a folder that stands for its root, as its user.

    python -m scripts.check.container

Paths of the Containerfile are moved below a temporary folder. Each RUN step is carried out by a shell, each COPY
copies, and then, as the user that USER names (where this is started by root): `kcal --version`, a live map with its
health check before and after it ends, and that the user cannot write where the program is. What cannot be seen this
way: the base image itself, and whether a builder understands the file.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import socket
import subprocess
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from kcal.io.rig_file import save_rig
from scripts.fuzz.readers import placed_rig
from scripts.shared.page import DOCS

ROOT = DOCS.parents[1]
_PLACES = ("/usr/src/kcal", "/opt/kcal", "/data")
_PYTHON = "/usr/bin/python3"  # that any user may run


class Step(NamedTuple):
    """A line of the Containerfile."""

    word: str
    rest: str


def steps() -> list[Step]:
    """The instructions, with continued lines joined."""
    text = re.sub(r"\\\n\s*", "", (ROOT / "Containerfile").read_text(encoding="utf-8"))
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    return [Step(*line.split(" ", 1)) for line in lines]


def moved(text: str, root: Path) -> str:
    """The text with its paths below the folder."""
    for place in _PLACES:
        text = re.sub(rf"(?<![\w/]){place}(?![\w-])", f"{root}{place}", text)
    return re.sub(r"^python3(?= )", _PYTHON, text)


def build(root: Path) -> dict[str, str]:
    """Carry out all steps below the folder, as the present user; the environment that they leave."""
    environment = {"PATH": os.environ["PATH"], "KCAL_CACHE": f"{root}/data/.cache"}
    for word, rest in steps():
        if word == "ENV":
            for name, value in (pair.split("=", 1) for pair in shlex.split(rest)):
                environment[name] = moved(value, root).replace("$PATH", environment["PATH"])
        elif word == "COPY":
            *sources, target = shlex.split(rest)
            for source in sources:
                place = Path(moved(target, root))
                if (ROOT / source).is_dir():
                    shutil.copytree(ROOT / source, place, ignore=shutil.ignore_patterns("__pycache__"))
                else:
                    place.mkdir(parents=True, exist_ok=True)
                    shutil.copy(ROOT / source, place)
        elif word == "RUN":
            pip = {name: value for name, value in os.environ.items() if name.startswith(("PIP_", "SSL_"))}
            subprocess.run(["sh", "-ec", moved(rest, root)], check=True, env=environment | pip, cwd=root)
    return environment


def health(root: Path, environment: dict[str, str], user: int | None) -> bool:
    """Whether the health check says that all is well."""
    (rest,) = (step.rest for step in steps() if step.word == "HEALTHCHECK")
    command = moved(rest.split("CMD ", 1)[1], root)
    return not subprocess.run(["sh", "-c", command], env=environment, user=user, capture_output=True).returncode


def main() -> None:
    owner = next(int(step.rest.split(":")[0]) for step in steps() if step.word == "USER")
    user = owner if os.geteuid() == 0 else None
    with tempfile.TemporaryDirectory(prefix="kcal-container-") as name:
        root = Path(name)
        root.chmod(0o755)
        start = time.monotonic()
        environment = build(root)
        kcal = json.loads(moved(next(step.rest for step in steps() if step.word == "ENTRYPOINT"), root))
        print(f"built in {time.monotonic() - start:.0f} s", flush=True)
        data = root / "data"
        with socket.create_server(("127.0.0.1", 0)) as probe:
            environment["KCAL_PORT"] = str(probe.getsockname()[1])
        said = subprocess.run([*kcal, "--version"], env=environment, user=user, check=True, capture_output=True)
        print(said.stdout.decode().strip())
        rig = save_rig(placed_rig(), data / "rig.json")
        rig.chmod(0o644)
        command = [*kcal, "live", "rig.json", "--detections", "-", "-o", "tracks.geojsonl", "--port",
                   environment["KCAL_PORT"]]  # fmt: skip
        live = subprocess.Popen(command, env=environment, user=user, cwd=data, stdin=subprocess.PIPE)
        try:
            until = time.monotonic() + 120
            while not health(root, environment, user) and time.monotonic() < until and live.poll() is None:
                time.sleep(1)
            assert health(root, environment, user), "the health check does not see the map"
        finally:
            live.terminate()
            live.wait(30)
        assert not health(root, environment, user), "the health check sees a map that has ended"
        assert (data / "tracks.geojsonl").exists(), "nothing was written"
        if user is not None:
            tried = subprocess.run(["touch", f"{root}/opt/kcal/x"], user=user, capture_output=True)
            assert tried.returncode, "the user can change the program"
        print("steps, user, live map, health check: as they should be")


if __name__ == "__main__":
    main()
