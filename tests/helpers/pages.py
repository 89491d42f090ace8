"""Every page that kcal serves or writes, with something on it."""

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import numpy as np
import torch
from calibrate_scenes import corner_pixels, observe
from capture_frames import BOARD as PHOTOGRAPHED
from capture_frames import images
from command_line import invoked, ran
from locate_rigs import located_pairs, pinhole_rig
from starlette.applications import Starlette
from track_scenes import pairs_of, run_of, tracked_site

from kcal import Origin
from kcal.capture.session import CaptureSession, capture_app
from kcal.io.images import write_png
from kcal.mark.guide import open_pictures
from kcal.mark.items import Add, Mark, Put
from kcal.mark.marking_service import Desk
from kcal.mark.server import marking_app
from kcal.mark.session import Session
from kcal.pipeline.senders import LiveMap
from kcal.pipeline.stream import track_columns
from kcal.report import save_map
from kcal.report.pages import save_summary
from kcal.track import Tracker, TrackOptions
from kcal.web.serving import LocalServer
from scripts.shared.marking_scene import LANDMARKS, TARGETS, MarkingSite, marking_site

ROOT = Path(__file__).parents[2]
ORIGIN = Origin(lat=19.07, lon=72.87, height=14.0)
# What opens a page: the place to go to, and what must be true of the page before it is looked at.
Opened = tuple[str, str]
DRAWN = "() => document.documentElement.dataset.drawn"


@contextmanager
def served(make_app: Callable[[str, tuple[str, ...]], Starlette]) -> Iterator[str]:
    """The address of an application while it is served by this process."""
    server = LocalServer(make_app, 0, fallback=False)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    try:
        yield server.address
    finally:
        server.stop()
        thread.join()


def write_site(folder: Path) -> tuple[MarkingSite, Path]:
    """Both pictures of a site and its survey."""
    site = marking_site(seed=0)
    for side, image in zip(("left", "right"), site.images, strict=True):
        write_png(folder / f"{side}.png", image)
    survey = folder / "survey.csv"
    survey.write_text(site.survey(0.02, np.random.default_rng(1)))
    return site, survey


@contextmanager
def desk_of(folder: Path) -> Iterator[tuple[Desk, MarkingSite]]:
    """A site to be marked, with its cameras and its survey."""
    site, survey = write_site(folder)
    pictures = open_pictures(folder / "left.png", folder / "right.png")
    desk = Desk(pictures, Session(folder / "marks.csv", survey), (site.rig.left, site.rig.right))
    yield desk, site
    desk.close()


@contextmanager
def marking(folder: Path) -> Iterator[Opened]:
    """The marking page after eight landmarks and two targets."""
    with desk_of(folder) as (desk, site):
        for point in (*LANDMARKS[:8], *TARGETS[:2]):
            if point in TARGETS:
                desk.session.do(Add(do="add", name=point.name, kind="target"), f"add {point.name}")
            for side, (u, v) in zip(("left", "right"), site.pixels[point.name], strict=True):
                mark = Mark(u=u, v=v, cov=(0.01, 0.0, 0.01), frame=desk.pictures.names[0])
                desk.session.do(Put(do="put", name=point.name, side=side, mark=mark), f"mark {point.name} {side}")
        desk._wake.set()
        with served(lambda token, hosts: marking_app(desk, token, hosts)) as address:
            yield address, "() => window.kcal && document.documentElement.dataset.pending === 'false'"


@contextmanager
def capturing(folder: Path) -> Iterator[Opened]:
    """The capture page after six views."""
    session = CaptureSession(folder / "x.obs.json", PHOTOGRAPHED)
    for i, image in enumerate(images()):
        session.offer(image, f"{i}.png", moving=False)
    session.think()
    stop = threading.Event()
    with served(lambda token, hosts: capture_app(session, stop, token, hosts)) as address:
        yield address, f"() => document.documentElement.dataset.views === '{session.views}'"


@contextmanager
def crowded_map(targets: int) -> Iterator[LiveMap]:
    """A live map of targets at 100 m to 3 km, many of them side by side."""
    site = tracked_site(0.01)
    page = LiveMap(run_of(site), 0)
    reach = 100.0 * 30.0 ** torch.linspace(0, 1, targets).double()
    side = 0.3 * reach * torch.sin(2.4 * torch.arange(targets).double())
    left, right = site.rig(torch.stack([side, 0 * side, reach], -1))[0].unbind(-2)
    page.show(track_columns(Tracker(site, TrackOptions(confirm_hits=1))(pairs_of(left, right, 1.0, 0.05)), 1), 1, 1.0)
    yield page
    page.close()


@contextmanager
def live(folder: Path) -> Iterator[Opened]:
    """The live map with 20 targets."""
    with crowded_map(20) as page:
        yield page.address, "() => document.documentElement.dataset.sequence === '1'"


@contextmanager
def verdict(folder: Path) -> Iterator[Opened]:
    """`kcal report` on a camera with its views."""
    observe(corner_pixels(14, 3, noise=0.05)).save(folder / "left.obs.json")
    known, seen = folder / "left.camera.json", folder / "left.obs.json"
    invoked("calibrate", seen, "-o", known, "--model", "opencv5")
    asked = ["--require", "50m:10%,1km:5%", "-o", folder / "page.html"]
    ran("report", known, "--observations", seen, *asked, catch_exceptions=False)
    yield (folder / "page.html").as_uri(), "() => true"


@contextmanager
def written_map(folder: Path) -> Iterator[Opened]:
    """The map of `kcal locate`, with true positions."""
    truth = torch.tensor([[20, 0, 100], [26, 0, 104], [-300, 5, 1000], [900, 0, 5000]]).double()
    rig = pinhole_rig()
    left, right = rig(truth)[0].unbind(-2)
    located = located_pairs(
        rig, left, right + torch.tensor([0.6, 0.0]), origin=ORIGIN, heading_deg=0.0,
        names=["gate", "a second gate beside it", "mast", "ship"],
    )  # fmt: skip
    yield save_map(folder / "map.html", located, truth[:, [0, 2, 1]] * torch.tensor([1, 1, -1])).as_uri(), DRAWN


@contextmanager
def summary(folder: Path) -> Iterator[Opened]:
    """The page of `kcal demo`: a part of every kind."""
    for name in ("map.png", "left.png", "right.png"):
        write_png(folder / name, np.full((400, 600), 128, np.uint8))
    table = (("name", *(f"column {i}" for i in range(9))), *((f"row {i}", *("12.3 m",) * 9) for i in range(3)))
    command = "kcal locate rig.json points.csv -o again.geojson --picture map.png " * 3
    values = {"folder": folder, "table": table, "command": command, "pairs": 3, "residuals": "RMS", "baseline": "10 m"}
    yield save_summary(folder / "s.html", "demo_pairs_page", **values).as_uri(), "() => true"


PAGES: dict[str, Callable[[Path], AbstractContextManager[Opened]]] = {
    "mark": marking, "capture": capturing, "live": live, "verdict": verdict, "map": written_map, "summary": summary,
}  # fmt: skip
