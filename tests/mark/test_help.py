import math
import threading
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import torch
from lenses import FEW_MODES, hybrid_camera
from locate_rigs import located_pairs
from waiting import wait_for

from kcal import InputError, Origin, Rig
from kcal.corners.match import Matches, MatchStatus, find_again
from kcal.io.images import write_png
from kcal.lens import rotation_from_vector
from kcal.locate.marks import Marks, write_marks
from kcal.mark.guide import Reference, RigBand, at_shape, open_pictures, propose
from kcal.mark.items import SIDES, Add, Mark, MarkingState, Place, Put, Side, SurveyPlace, applied
from kcal.mark.marking_service import Desk, Promise, map_content, solve_live, verdict
from kcal.mark.session import Session, marks_of
from kcal.mark.shapes import snap
from kcal.rig import RigCovariance, Survey
from kcal.watch.turned import check_rig, seen_again
from scripts.shared.marking_scene import (
    LANDMARKS,
    MarkingSite,
    background,
    finished,
    inside_of,
    marking_site,
    paint,
    seen,
    site_rig,
)

SIZE = 61


@pytest.fixture(scope="module")
def site() -> MarkingSite:
    return marking_site(seed=1, width=800, height=450)


class TestSnap:
    # Cramer-Rao bounds of 1.5 levels of noise at 60 levels of contrast are 0.01 to 0.03 px; single targets, so 4 sigma.
    @pytest.mark.parametrize(
        ("kind", "shape", "limit"),
        [("corner", "corner", 0.1), ("cross", "cross", 0.06), ("quadrants", "corner", 0.06), ("pole", "end", 0.12),
         ("lamp", "blob", 0.08)],
    )  # fmt: skip
    def test_finds_the_point_of_each_shape(self, kind: str, shape: str, limit: float) -> None:
        random = np.random.default_rng(5)
        for _ in range(2):
            image, at = np.full((SIZE, SIZE), 100.0), 30 + random.uniform(-0.5, 0.5, 2)
            paint(image, at, np.eye(2), inside_of(kind, random), 60.0, 0.8)
            found = snap(finished(image, 1.5, random), *(at + random.uniform(-1.5, 1.5, 2)))
            assert found.how == shape
            assert np.abs(np.array([found.u, found.v]) - at).max() < limit
            assert 0.019 < math.sqrt(found.cov[0]) < 0.1

    def test_does_not_depend_on_the_click(self) -> None:
        random = np.random.default_rng(6)
        image = np.full((SIZE, SIZE), 100.0)
        paint(image, np.array([30.2, 29.9]), np.eye(2), inside_of("cross", random), 60.0, 0.8)
        noisy = finished(image, 1.5, random)
        found = [snap(noisy, 30.2 + du, 29.9 + dv) for du, dv in ((0, 0), (2, 0), (-1.5, 1.5), (0.5, -2.5))]
        assert np.ptp([point.u for point in found]) < 0.01
        assert np.ptp([point.v for point in found]) < 0.01

    def test_refuses_what_is_no_point(self) -> None:
        flat = finished(np.full((SIZE, SIZE), 100.0), 0.3, np.random.default_rng(0))
        with pytest.raises(InputError, match="flat"):
            snap(flat, 30, 30)
        axis = np.arange(SIZE)
        edge = np.where(axis > 30.5 + 0 * axis[:, None], 160, 60).astype(np.float64)
        with pytest.raises(InputError, match="mark"):
            snap(finished(edge, 1.5, np.random.default_rng(0)), 30, 30)
        with pytest.raises(InputError, match="border"):
            snap(flat, 3, 30)


class TestCurve:
    def test_passes_through_the_other_mark_from_either_side(self, site: MarkingSite) -> None:
        band = RigBand(site.rig)
        for name in ("post 1", "post 5", "post 12"):
            both = site.pixels[name]
            for side, here, there in (("left", both[0], both[1]), ("right", both[1], both[0])):
                line = band.curve(cast("Side", side), *here).pixels.numpy()
                a, b = line[:-1], line[1:]
                share = ((there - a) * (b - a)).sum(-1) / np.square(b - a).sum(-1)
                nearest = a + np.clip(share, 0, 1)[:, None] * (b - a)
                assert np.linalg.norm(nearest - there, axis=-1).min() < 0.01

    def test_the_band_is_the_spread_of_curves(self, site: MarkingSite) -> None:
        pose = torch.diag(torch.tensor([2e-4, 1e-4, 3e-4, 1e-3, 1e-2, 1e-2]).double() ** 2)
        rig = Rig.pair(site.rig.left, site.rig.right, site.rig.right_from_left_rotation,
                        site.rig.right_from_left_translation)  # fmt: skip
        rig.covariance = RigCovariance.of(rig, pose=pose)
        curve = RigBand(rig).curve("left", 300.0, 200.0)
        generator = torch.Generator().manual_seed(0)
        rays, _ = rig.left.unproject(torch.tensor([[300.0, 200.0]]).double())
        offsets = []
        for _ in range(400):
            move = pose.diagonal().sqrt() * torch.randn(6, generator=generator, dtype=torch.float64)
            turned = rotation_from_vector(move[:3]) @ rig.right_from_left_rotation
            # At infinity the translation does not matter.
            pixel, _ = rig.right.project_rays(rays @ turned.T)
            offsets.append(pixel[0] - curve.pixels[0])
        along = torch.nn.functional.normalize(curve.pixels[1] - curve.pixels[0], dim=0)
        across = torch.stack(offsets) @ torch.stack([-along[1], along[0]])
        # 400 draws: 3.5 % of a standard deviation.
        assert float(across.std()) == pytest.approx(float(curve.sigma[0]), rel=0.12)

    @pytest.mark.parametrize("side", ["left", "right"])
    def test_the_band_of_a_default_lens_is_that_of_moved_rigs(self, side: Side) -> None:
        """Errors of lenses, entrance pupils and pose, moved one by one by a thousandth of a sigma of each."""
        lenses = hybrid_camera("webcam", 1, FEW_MODES), hybrid_camera("wide", 2, FEW_MODES)
        values = [lens.params + torch.tensor([0.02 * (name == "pupil1") for name in lens.names]) for lens in lenses]
        cameras = [lens.with_parameters(value) for lens, value in zip(lenses, values, strict=True)]
        turn = rotation_from_vector(torch.tensor([0.01, -0.03, 0.02]).double())
        shift = torch.tensor([-10.0, 0.1, 0.3]).double()
        rig = Rig.pair(cameras[0], cameras[1], turn, shift)
        ends = [len(value) for value in values]
        size = torch.cat([*(1e-3 * value.abs() + 1e-5 for value in values), torch.full((6,), 1e-3).double()])
        half = size * torch.randn(4, len(size), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        rig.covariance = RigCovariance(half=half)
        curve = RigBand(rig).curve(side, 700.0, 400.0)
        along = torch.nn.functional.normalize(torch.gradient(curve.pixels, dim=0)[0], dim=-1)
        across, squares = torch.stack([-along[:, 1], along[:, 0]], -1), torch.zeros(len(along)).double()
        for move in 1e-3 * half:
            left, right, pose = move.tensor_split([ends[0], sum(ends)])
            moved = Rig.pair(
                cameras[0].with_parameters(values[0] + left), cameras[1].with_parameters(values[1] + right),
                rotation_from_vector(pose[:3]) @ turn, shift + pose[3:],
            )  # fmt: skip
            # Far things move along the curve besides, and not across it.
            there = RigBand(moved).curve(side, 700.0, 400.0).pixels
            squares += (((there - curve.pixels) * across).sum(-1) / 1e-3).square()
        assert len(along) > 90
        torch.testing.assert_close(curve.sigma, squares.sqrt(), rtol=0.01, atol=0)

    def test_it_begins_where_infinity_is_seen(self) -> None:
        """With an entrance pupil that wanders by centimeters: as far as anything is away, they do not matter."""
        camera = hybrid_camera("wide", 2, FEW_MODES)
        moved = camera.with_parameters(
            camera.params + torch.tensor([0.05 * (name == "pupil1") for name in camera.names])
        )
        rig = Rig.pair(moved, moved, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        pixel = torch.tensor([[200.0, 300.0]]).double()
        curve = RigBand(rig).curve("left", *pixel[0].tolist())
        torch.testing.assert_close(curve.pixels[0], pixel[0], rtol=0, atol=1e-6)
        # Its end, at three baselines, is where a thing there is seen.
        rays, _ = moved.unproject(pixel)
        near, _ = moved.project(rig.right_from_left(moved.ray_origins(rays) + 30.0 * rays))
        torch.testing.assert_close(curve.pixels[-1], near[0], rtol=0, atol=1e-6)


class TestProposal:
    def test_a_cross_before_hills(self, site: MarkingSite) -> None:
        left, right = site.pixels["post 9"]
        found = propose(site.rig, site.images, "left", *left)
        assert found.refusal == ""
        assert math.hypot(found.u - right[0], found.v - right[1]) < 0.3
        there = at_shape(found, site.images[1], "cross")
        assert there.how == "cross"
        assert math.hypot(there.u - right[0], there.v - right[1]) < 3 * math.sqrt(there.cov[0])
        assert there.cov[0] < 0.1**2
        back = propose(site.rig, site.images, "right", *right)
        assert math.hypot(back.u - left[0], back.v - left[1]) < 0.3

    def test_refuses_and_says_why(self, site: MarkingSite) -> None:
        left, right = site.pixels["post 9"]
        hidden = site.images[1].copy()
        row, column = round(right[1]), round(right[0])
        hidden[row - 20 : row + 20, column - 20 : column + 20] = np.random.default_rng(0).integers(90, 150, (40, 40))
        assert "is it hidden" in propose(site.rig, (site.images[0], hidden), "left", *left).refusal
        flat = np.full_like(hidden, 120)
        assert "flat" in propose(site.rig, (flat, flat), "left", *left).refusal
        rig, random = site_rig(800, 450), np.random.default_rng(0)
        images = [background(rig, side, np.random.default_rng(1)) for side in (0, 1)]
        point = torch.tensor([0.0, 5.0, 300.0]).double()
        inside = inside_of("quadrants", random)
        for side in (0, 1):
            at, matrix = seen(rig, point, side)
            for step in range(-2, 3):
                paint(images[side], at + np.array([28.0 * step, 0.0]), matrix, inside, 60.0, 0.8)
        fence = finished(images[0], 1.5, random), finished(images[1], 1.5, random)
        assert "repeated" in propose(rig, fence, "left", *seen(rig, point, 0)[0]).refusal


class TestWayBack:
    """A match is believed if the way back ends within half a pixel and four sigmas of where it began."""

    @pytest.mark.parametrize(("miss", "refused"), [(0.0, False), (0.85, False), (0.95, True)])
    def test_its_limit(self, site: MarkingSite, monkeypatch: pytest.MonkeyPatch, miss: float, refused: bool) -> None:
        def found(u: float) -> Matches:
            return Matches(
                torch.tensor([[u, 200.0]]).double(), torch.eye(2).double()[None] * 0.1**2, torch.tensor([0]),
                torch.ones(1).double(), torch.zeros(1).double(),
            )  # fmt: skip

        answers = iter([found(280.0), found(300.0 + miss)])
        monkeypatch.setattr("kcal.mark.guide.match_points", lambda *_: next(answers))
        proposal = propose(site.rig, site.images, "left", 300.0, 200.0)
        assert (proposal.u, proposal.v) == (280.0, 200.0)
        assert ("the way back ends" in proposal.refusal) == refused


def survey_of(site: MarkingSite, names: list[str]) -> Survey:
    points = torch.stack([site.points[name] for name in names])
    return Survey(tuple(names), points, torch.full_like(points, 0.02), None)


def marks_at(site: MarkingSite, names: list[str], sigma: float = 0.05) -> Marks:
    noise = sigma * np.random.default_rng(3).normal(size=(len(names), 2, 2))
    pixels = torch.from_numpy(np.array([site.pixels[name] for name in names]) + noise)
    return Marks(tuple(names), pixels, sigma**2 * torch.eye(4).double().expand(len(names), 4, 4))


class TestLiveRig:
    def test_sigma_falls_with_landmarks(self, site: MarkingSite) -> None:
        names = [point.name for point in LANDMARKS]
        cameras = site.rig.left, site.rig.right
        few = solve_live(cameras, survey_of(site, names), marks_at(site, names[:3]), 0.3)
        assert few.rig is None
        assert few.text == "1 more landmark in both images for a rig"
        found = [solve_live(cameras, survey_of(site, names), marks_at(site, names[:n]), 0.3) for n in (5, 12)]
        parts = [promise.rig for solved in found for promise in solved.promises if promise.distance == 1000]
        assert parts[0] is not None
        assert parts[1] is not None
        assert parts[1] < parts[0]
        assert found[1].rig is not None
        assert float(found[1].rig.baseline) == pytest.approx(10.0, abs=0.2)

    @pytest.mark.slow
    def test_a_mark_in_one_image_worsens_nothing(self, site: MarkingSite) -> None:
        """Neither does one placed by hand: each counts with its own sigma."""
        names = [point.name for point in LANDMARKS]
        whole, survey = marks_at(site, names[:8]), survey_of(site, names)
        assert whole.covariance is not None
        cameras = site.rig.left, site.rig.right

        def total(marks: Marks) -> list[float]:
            return [promise.rig or math.nan for promise in solve_live(cameras, survey, marks, 0.3).promises]

        before = total(Marks.of_pair(whole.names[:7], whole.left[:7], whole.right[:7], whole.covariance[:7]))
        one, missing = whole.covariance.clone(), whole.right.clone()
        one[7, 2:], one[7, :, 2:], missing[7] = math.nan, math.nan, math.nan
        half = Marks.of_pair(whole.names, whole.left, missing, one)
        assert half.typical_sigma(0.3) == pytest.approx(0.05)
        by_hand = Marks.of_pair(whole.names, whole.left, whole.right, whole.covariance.clone())
        assert by_hand.covariance is not None
        by_hand.covariance[7] = 0.3**2 * torch.eye(4)
        # The residuals of seven landmarks are not those of eight.
        for after in (total(half), total(by_hand)):
            assert max(b / a for a, b in zip(before, after, strict=True)) < 1.01

    def test_a_wrong_landmark_is_named(self, site: MarkingSite) -> None:
        names = [point.name for point in LANDMARKS]
        marks = marks_at(site, names)
        marks.left[4] += 3.0
        found = solve_live((site.rig.left, site.rig.right), survey_of(site, names), marks, 0.3)
        assert [item.name for item in found.items if not item.used] == ["post 5"]
        assert found.text.startswith("post 5 contradicts the other landmarks")

    @pytest.mark.slow
    @pytest.mark.parametrize(("zoom", "blamed"), [(None, True), (0.24, False)])
    def test_marks_from_afar_are_not_blamed(self, site: MarkingSite, zoom: float | None, blamed: bool) -> None:
        """Clicked at 0.24 times, three marks are up to 6 px off: right ones, as far as anyone could see."""
        names, random = [point.name for point in LANDMARKS[:10]], np.random.default_rng(5)
        state = MarkingState()
        for number, name in enumerate(names):
            state = applied(state, Add(do="add", name=name, kind="landmark"))
            for side, at in zip(SIDES, site.pixels[name], strict=True):
                afar = number < 3
                u, v = at + (random.uniform(-1, 1, 2) / 0.24 if afar else random.normal(0, 0.1, 2))
                clicked = Mark(u=u, v=v, cov=(0.09, 0.0, 0.09) if afar else (0.01, 0.0, 0.01))
                put = Put(do="put", name=name, side=side, mark=clicked, zoom=zoom if afar else 12.0)
                state = applied(state, put)
        found = solve_live((site.rig.left, site.rig.right), survey_of(site, names), marks_of(state, ("landmark",)), 0.3)
        assert [item.name for item in found.items if not item.used] == (names[:3] if blamed else [])
        assert ("contradict" in found.text) == blamed
        # What is promised of a target that is marked from near does not grow with them.
        assert found.sigma <= 0.3
        far = solve_live((site.rig.left, site.rig.right), survey_of(site, names), marks_at(site, names, 4.0), 0.3)
        assert not far.enough
        assert "; 20 marks have a σ above 0.6 px: zoom in at each and press S" in far.text

    def test_enough_has_a_number(self) -> None:
        assert verdict((Promise(5000.0, 150.0, 100.0, 180.0),), 8) == (
            "enough: at 5 km the rig errs by 100 m, marks by 150 m", True,
        )  # fmt: skip
        assert "landmarks farther away" in verdict((Promise(5000.0, 15.0, 300.0, 335.0),), 8)[0]
        # A rig of 8 cm.
        text, _ = verdict((Promise(50.0, 0.84, 0.52, 0.99),), 8)
        assert text == "enough: at 50 m the rig errs by 0.52 m, marks by 0.84 m"


class TestDrift:
    def test_points_are_found_again_and_the_turn_is_measured(self, site: MarkingSite, tmp_path: Path) -> None:
        """The right camera turns; the reference's marks are found in its new image, and `check_rig` reads them."""
        turn = torch.tensor([1e-3, -2e-3, 5e-4]).double()
        moved = rotation_from_vector(turn) @ site.rig.right_from_left_rotation
        rays, valid = site.rig.right.unproject(site.rig.right.grid(800, 450))
        shown, _ = site.rig.right.project_rays(rays @ rotation_from_vector(turn))
        size = torch.tensor([799.0, 449.0])
        image = torch.from_numpy(site.images[1].astype(np.float64))[None, None]
        new = torch.nn.functional.grid_sample(image, (2 * shown / size - 1)[None], mode="bicubic", align_corners=True)
        assert bool(valid.all())
        for name, gray in (("left", site.images[0]), ("right", site.images[1]),
                           ("new-right", new[0, 0].clamp(0, 255).round().to(torch.uint8).numpy())):  # fmt: skip
            write_png(tmp_path / f"{name}.png", gray)
        names = [point.name for point in LANDMARKS]
        then = marks_at(site, names, 0.02)
        write_marks(tmp_path / "then.csv", then)
        reference = Reference(tmp_path / "then.csv", tmp_path / "left.png", tmp_path / "right.png")
        session = Session(tmp_path / "now.csv")
        desk = Desk(
            open_pictures(tmp_path / "left.png", tmp_path / "new-right.png"), session, None, site.rig, reference
        )
        for number, name in enumerate(names):
            session.do(Add(do="add", name=name, kind="feature"), f"add-{number:05d}")
            for side in ("left", "right"):
                found = desk.again(name, cast("Side", side), 0, 8)
                if not found["refusal"]:
                    mark = Mark(u=found["u"], v=found["v"], cov=found["cov"], how="again", frame="left")
                    session.do(Put(do="put", name=name, side=cast("Side", side), mark=mark), f"{side}-{number:05d}")
        now = marks_of(session.state, ("feature",), single=False)
        desk.close()
        assert len(now.names) >= 10
        drift = check_rig(site.rig, features=seen_again(then, now, 0.05))
        assert drift.significant
        found_turn = drift.rig.right_from_left_rotation @ site.rig.right_from_left_rotation.T
        expected = moved @ site.rig.right_from_left_rotation.T
        # 0.05 px in ten points of f 667 px are 2e-5 rad about x and y.
        torch.testing.assert_close(found_turn, expected, atol=1.5e-4, rtol=0)

    def test_statuses(self) -> None:
        random = np.random.default_rng(0)
        image = torch.from_numpy(random.normal(100, 20, (120, 160)))
        smooth = torch.nn.functional.avg_pool2d(image[None, None], 5, 1, 2)[0, 0]
        pixels = torch.tensor([[80.0, 60.0], [3.0, 60.0], [torch.nan, 60.0]])
        found = find_again(smooth, smooth.roll((2, -7), (0, 1)), pixels, reach=12)
        assert [MatchStatus(int(code)).name for code in found.status] == ["GOOD", "OUTSIDE", "NO_RAY"]
        torch.testing.assert_close(found.pixels[0], torch.tensor([73.0, 62.0]).double(), atol=0.01, rtol=0)
        other = torch.from_numpy(random.normal(100, 20, (120, 160)))
        assert int(find_again(smooth, other, pixels[:1], reach=12).status[0]) == MatchStatus.NO_MATCH
        flat = torch.full((120, 160), 5.0)
        assert int(find_again(flat, smooth, pixels[:1], reach=12).status[0]) == MatchStatus.FLAT


def test_the_map_shows_each_region_at_its_target(site: MarkingSite) -> None:
    """Also behind a target that has a bearing only, and no region."""
    left, right = (torch.tensor(marks, dtype=torch.float64) for marks in zip(*site.pixels.values(), strict=True))
    far = site.rig.left.project(torch.tensor([[0.0, 0.0, 1e7]]).double())[0]
    left = torch.cat([far, left])
    right = torch.cat([site.rig(torch.tensor([[0.0, 0.0, 1e7]]).double())[0][:, 1], right])
    names = ["far", *site.pixels]
    located = located_pairs(site.rig, left, right, names=names, origin=Origin(lat=0, lon=0, height=0), heading_deg=0.0)
    shown = {target["name"]: target for target in map_content(site.rig, located, None, anchored=False)["targets"]}
    assert shown["far"]["ring"] is None
    assert sum(target["ring"] is not None for target in shown.values()) == located.count > 3
    for target in shown.values():
        if target["ring"] is not None:
            ring = np.array(target["ring"])
            assert (ring.min(0) < target["place"]).all()
            assert (target["place"] < ring.max(0)).all()


def test_a_desk_from_clicks_to_positions(site: MarkingSite, tmp_path: Path) -> None:
    for side, image in zip(("left", "right"), site.images, strict=True):
        write_png(tmp_path / f"{side}.png", image)
    session = Session(tmp_path / "marks.csv")
    desk = Desk(open_pictures(tmp_path / "left.png", tmp_path / "right.png"), session, None, site.rig)
    desk.check_sizes()
    left, right = site.pixels["gate"]
    desk.act(Add(do="add", name="gate", kind="target"), "key-00001")
    for side, at in (("left", left), ("right", right)):
        mark = Mark(u=at[0], v=at[1], cov=(0.0025, 0.0, 0.0025), frame="left")
        state = desk.act(Put(do="put", name="gate", side=cast("Side", side), mark=mark), f"key-{side}")
    wait_for(lambda: not desk.state()["pending"])
    state = desk.state()
    position = state["items"][0]["position"]
    true = float(torch.linalg.vector_norm(site.points["gate"]))
    assert position["low"] < true < position["high"]
    assert position["place"] == ""
    desk.act(SurveyPlace(do="survey", name="tree", place=Place(at=(1.0, 2.0, 3.0), sigma=0.1)), "key-00009")
    assert desk.map()["targets"][0]["name"] == "gate"
    dragged = desk.position(Mark(u=left[0] + 1, v=left[1], cov=(0.09, 0, 0.09)),
                            Mark(u=right[0], v=right[1], cov=(0.09, 0, 0.09)), None)  # fmt: skip
    assert dragged["range"] < true
    desk.close()


def test_what_is_not_pending_is_solved(site: MarkingSite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if the solution comes while the state is being told."""
    for side, image in zip(("left", "right"), site.images, strict=True):
        write_png(tmp_path / f"{side}.png", image)
    desk = Desk(
        open_pictures(tmp_path / "left.png", tmp_path / "right.png"), Session(tmp_path / "marks.csv"), None, site.rig
    )
    wait_for(lambda: not desk.state()["pending"])
    begin, solve, undoable = threading.Event(), desk._solve, Session.undoable.fget

    def held(state: MarkingState) -> None:
        begin.wait()
        solve(state)

    def late(session: Session) -> tuple[bool, bool]:
        begin.set()
        wait_for(lambda: desk._solved == session.version)
        return undoable(session)

    monkeypatch.setattr(desk, "_solve", held)
    desk.session.do(Add(do="add", name="mast", kind="landmark"), "key-00001")
    desk.session.do(SurveyPlace(do="survey", name="mast", place=Place(at=(1.0, 2.0, 3.0), sigma=0.1)), "key-00002")
    for side, (u, v) in zip(("left", "right"), site.pixels["gate"], strict=True):
        mark = Mark(u=u, v=v, cov=(0.01, 0.0, 0.01), frame="left")
        desk.session.do(Put(do="put", name="mast", side=cast("Side", side), mark=mark), f"key-{side}")
    desk._wake.set()
    with monkeypatch.context() as patched:
        patched.setattr(Session, "undoable", property(late))
        told = desk.state()
    assert told["pending"] == (told["rig"]["count"] == 0)
    assert desk.state()["rig"]["count"] == 1
    desk.close()
