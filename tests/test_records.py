"""What long simulations share: files of finished captures, stretched images, intervals over captures."""

from pathlib import Path
from typing import Any

import pytest
import torch

from kcal.lens.camera import Camera
from scripts.check import captures_that_move, ordinary, verdict
from scripts.shared.held_out import held_out
from scripts.shared.page import Kept, seeds
from scripts.shared.peer_lenses import SplinedCamera
from scripts.shared.simulated import BOARD, stretched


def test_an_interrupted_run_goes_on_where_it_stopped(tmp_path: Path) -> None:
    out, done = tmp_path / "a" / "out.jsonl", []

    def work(kind: str, seed: int) -> dict[str, Any]:
        if seed == 2 and len(done) == 2:
            raise KeyboardInterrupt
        done.append(seed)
        return {"value": 10 * seed}

    with pytest.raises(KeyboardInterrupt):
        Kept((out,)).records([("x", seed) for seed in range(4)], work)
    done.append(-1)
    records = Kept((out,)).records([("x", seed) for seed in range(4)], work)
    assert done == [0, 1, -1, 2, 3]
    assert [record["value"] for record in records] == [0, 10, 20, 30]


def test_records_of_split_runs_count_once(tmp_path: Path) -> None:
    paths = tuple(tmp_path / name for name in ("a", "b", "missing"))
    Kept(paths[:1]).records([(0,), (1,)], lambda seed: {"from": "a"})
    Kept(paths[1:2]).records([(1,), (2,)], lambda seed: {"from": "b"})
    found = Kept(paths, only=True).records([(3,)], lambda seed: {"from": "nowhere"})
    assert [(record["key"][0], record["from"]) for record in found] == [(0, "a"), (1, "a"), (2, "b")]


def test_without_a_file_records_are_what_a_file_would_give() -> None:
    assert Kept().records([("x", 1)], lambda *key: {"pair": key}) == [{"key": ["x", 1], "pair": ["x", 1]}]


def test_seeds_include_the_last() -> None:
    assert list(seeds("3-5")) == [3, 4, 5]
    assert list(seeds("7")) == [7]


def test_a_stretched_image_is_that_of_a_camera_with_long_pixels() -> None:
    camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), model="pinhole")
    longer = Camera.build(focal=(800, 880), center=(319.5, 263.5), size=(640, 528), model="pinhole")
    turn = torch.tensor([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]]).double()
    points = BOARD.points @ turn.T + torch.tensor([-0.15, -0.1, 1.0]).double()
    pixels = camera.project(points)[0].detach()[None]
    pixels[0, 5] = torch.nan
    spread = torch.tensor([[0.01, 0.002], [0.002, 0.04]]).double().expand(1, len(points), 2, 2)
    seen = stretched(pixels, spread, camera.size, 1.1)
    assert seen.image_size == (640, 528)
    assert held_out(longer, BOARD.points, seen.pixels()).still < 1e-9
    found = seen.covariances()
    assert torch.allclose(found[0, 0], torch.tensor([[0.01, 0.0022], [0.0022, 0.0484]]).double())
    assert found[0, 5].isnan().all()


def test_mrcals_spline_projects_as_mrcal_does() -> None:
    """Constant control points shift the image; linear ones are reproduced by cubic splines."""
    x, y = torch.meshgrid(torch.arange(11.0), torch.arange(8.0), indexing="xy")
    control = torch.stack([0.02 * (x - 5.0), 0.03 * (y - 3.5) + 0.1], -1)  # x: 0.02 a knot
    found = {"intrinsics": [500, 400, 320, 240, *control.flatten().tolist()], "knots": [-1.0, -0.8]}
    camera = SplinedCamera(found, (640, 480), (11, 8))
    rays = torch.tensor([[0.1, 0.2, 1.0], [-0.4, 0.3, 1.0], [0, 0, 2.0]]).double()
    u = 2 * rays[:, :2] / (rays.norm(dim=-1) + rays[:, 2])[:, None]
    shifted = u + torch.stack([0.1 * u[:, 0], 0.15 * u[:, 1] + 0.1], -1)
    wanted = shifted * torch.tensor([500.0, 400.0]) + torch.tensor([320.0, 240.0])
    pixels, valid = camera.project(rays)
    assert valid.all()
    assert torch.allclose(pixels, wanted)
    back, good = camera.unproject(pixels)
    assert good.all()
    assert torch.allclose(back, rays / rays.norm(dim=-1, keepdim=True))


def test_a_lost_corner_is_no_victory() -> None:
    whole, lost = {"still": 0.2, "moved": 0.1, "lost": 0}, {"still": 0.1, "moved": 0.1, "lost": 1}
    record = {"held": {"kcal": whole, "opencv5": lost, "fisheye": {"failed": "no"}, "opencv8": {**whole, "still": 0.1}}}
    assert ordinary.over_best(record) == {"still": 2.0, "moved": 1.0}
    assert ordinary.over_best({"held": {"kcal": lost, "opencv5": whole}})["still"] == float("inf")
    assert ordinary.over_best({"held": {"opencv5": whole}}) == {}


def test_the_table_of_captures_tells_answers_and_leaves_out_what_was_not_measured() -> None:
    held = {model: {"still": 0.2, "moved": 0.1, "lost": 0} for model in ("kcal", "opencv5")}
    whole = {"yes": False, "rms": 0.31, "worst": "two cameras"}
    good = {"key": ["a.obs.json"], "views": [7, 8], "held": held, "refused": [], "ratio": 0.9, "p": 0.4, "whole": whole}
    bad = {"key": ["b"], "views": [7, 8], "held": {}, "refused": ["few"], "whole": {"refused": "of two sizes"}}
    text = "\n".join(ordinary.lines([good, bad]))
    assert "| a | no, 0.3100 | 7+8 | 0.90 (0.4) | 0.2000 / 0.1000 | 0.2000 / 0.1000 | 1.00 / 1.00 |" in text
    assert "| b | refused | 7+8 | refused | – | – | – |" in text
    assert text.endswith("- `a`: two cameras\n- `b`: of two sizes\n- half of `b`, refused: few")
    assert "mrcal" not in text


def test_tables_count_what_was_refused_and_said() -> None:
    good = {"rms": 1.0, "predicted": 1.0, "inside": 0.9, "beyond": 1.0, "everywhere": 0.95}
    records = [
        {"key": ["hand", 8, 0, "default"], **good},
        {"key": ["hand", 8, 1, "default"], **good, "rms": 3.0, "everywhere": 0.85},
        {"key": ["hand", 8, 2, "default"], "refused": "too few"},
        {"key": ["stand", 8, 2, "default"], "refused": "too few"},
    ]
    rows = [*captures_that_move.lines("none", records)][2:]
    assert rows[0] == "| 8 | hand | default | 3 | 33.3 % | 90.0 ± 5.0 | 2.000 | 2.236 | 1.000 |"
    assert "100.0 %" in rows[1]
    said = [
        {"key": [1.01, k], "factor": 1.01, "aspect": 1.012, "hand": k == 0, "said": text}
        for k, text in enumerate(([], ["pixels are not square"], ["pixels are not square"]))
    ]
    assert [*verdict.aspect_lines(said)][2:] == [
        "| 1.01 | by hand | 1 | 0 | 0.0 % | – |",
        "| 1.01 | on a stand | 2 | 2 | 100.0 % | 0.0020 |",
    ]
