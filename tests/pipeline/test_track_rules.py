"""When tracks are told, lost, forgotten and recognized; how far bands of epipolar lines and patches of looks reach."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.special import chdtrc
from track_scenes import pairs_of, tracked_site

from kcal.pipeline.association import _patches, appearance
from kcal.pipeline.pairing import ObjectViews
from kcal.pipeline.tracks import Tracker, TrackOptions, TrackRecord, _toward
from kcal.track import Motion

SLOW = TrackOptions(motions=(Motion(acceleration=0.05),), confirm_hits=3, lose_after_s=1.0, forget_after_s=4.0)
HERE = (0.0, 0.0, 400.0)


class Scene:
    """A tracker of the planned rig, and exact marks of places in the rig's frame."""

    def __init__(self, options: TrackOptions = SLOW) -> None:
        localize = tracked_site()
        self.tracker, self.rig = Tracker(localize, options), localize.rig

    def pairs(self, time: float, *places: tuple[float, float, float], doubt: bool = False) -> ObjectViews:
        left, right = self.rig(torch.tensor(places).double().reshape(-1, 3))[0].unbind(-2)
        return pairs_of(left, right, time, 0.2, [doubt] * len(places))

    def see(self, time: float, *places: tuple[float, float, float], doubt: bool = False) -> tuple[int, ...]:
        """Numbers of the tracks that are told then."""
        return self.tracker(self.pairs(time, *places, doubt=doubt), time).number


class TestRules:
    def test_told_after_three_sightings_or_six_doubtful_ones(self) -> None:
        scene = Scene()
        assert [scene.see(0.1 * k, HERE) for k in range(4)] == [(), (), (1,), (1,)]
        assert scene.tracker.records[0].hits == 4
        doubtful = Scene()
        assert [doubtful.see(0.1 * k, HERE, doubt=True) for k in range(7)] == [*[()] * 5, (1,), (1,)]
        # Two rows of one moment count once.
        again = Scene()
        for k in range(2):
            again.see(0.1 * k, HERE)
        assert again.see(0.1) == ()
        assert again.tracker.records[0].hits == 2

    def test_told_for_a_second_and_remembered_for_four(self) -> None:
        scene = Scene()
        for k in range(4):
            scene.see(0.1 * k, HERE)
        assert scene.see(1.3) == (1,)
        assert scene.tracker.tracks().unseen_s.tolist() == [pytest.approx(1.0)]
        assert scene.see(1.31) == ()
        scene.see(4.29)
        assert len(scene.tracker.records) == 1
        scene.see(4.31)
        assert scene.tracker.records == []
        assert scene.tracker.frame.shape[-1] == len(scene.tracker.home) == scene.tracker.beliefs.mean.shape[-1] == 0

    def test_what_is_not_told_yet_is_forgotten_after_half_a_second(self) -> None:
        for gap, kept in ((0.49, 1), (0.51, 0)):
            scene = Scene()
            scene.see(0.0, HERE)
            scene.see(gap)
            assert len(scene.tracker.records) == kept

    def test_a_lost_track_takes_no_sighting_but_is_recognized(self) -> None:
        """With its number, its first moment and its hits; where two could be it, the new one is another."""
        scene = Scene()
        for k in range(4):
            scene.see(0.1 * k, HERE)
        assert scene.see(2.0, HERE) == ()
        assert len(scene.tracker.records) == 2
        scene.see(2.1, HERE)
        assert scene.see(2.2, HERE) == (1,)
        record = scene.tracker.records[0]
        assert (len(scene.tracker.records), record.first, record.hits) == (1, 0.0, 7)
        assert scene.tracker.next_number == 2
        for elsewhere in ((60.0, 0.0, 400.0), (0.0, 0.0, 600.0)):
            other = Scene()
            for k in range(4):
                other.see(0.1 * k, HERE)
            numbers = [other.see(2.0 + 0.1 * k, elsewhere) for k in range(3)]
            assert numbers[-1] == (2,)
        two = Scene()
        for k in range(4):
            two.see(0.1 * k, HERE, (0.2, 0.0, 400.0))
        assert [two.see(2.0 + 0.1 * k, (0.1, 0.0, 400.0)) for k in range(3)][-1] == (3,)

    def test_a_track_keeps_what_it_sees_now(self) -> None:
        scene = Scene()
        for k in range(4):
            scene.see(0.1 * k, HERE, (30.0, 0.0, 500.0))
        told = scene.tracker(scene.pairs(0.4, (30.0, 0.0, 500.0)), 0.4)
        assert told.number == (1, 2)
        assert told.seen.tolist() == [[False, False], [True, True]]
        assert told.hits.tolist() == [4, 5]
        assert told.unseen_s.tolist() == pytest.approx([0.1, 0.0])
        assert told.time == 0.4

    def test_the_time_is_that_of_the_first_camera(self) -> None:
        scene = Scene()
        pairs = scene.pairs(0.0, HERE, (30.0, 0.0, 500.0))
        times = torch.tensor([[7.0, 7.4], [7.1, 7.6]]).double()
        assert scene.tracker(dataclasses.replace(pairs, time=times)).time == pytest.approx(7.1)
        views = dataclasses.replace(pairs, time=times + 1.0)
        right = dataclasses.replace(views, seen=torch.tensor([[False, True]] * 2))
        assert scene.tracker(right).time == pytest.approx(8.6)

    def test_a_clock_that_was_set_ends_tracks_and_not_their_numbers(self) -> None:
        scene = Scene()
        for k in range(3):
            scene.see(50.0 + 0.1 * k, HERE)
        scene.tracker.set_clock(20.0)
        assert scene.tracker.shared.start == pytest.approx(50.0 - 30.2)
        assert scene.tracker.records == []
        assert [scene.see(20.0 + 0.1 * k, HERE) for k in range(3)] == [(), (), (2,)]
        scene.tracker.set_clock(90.0)
        assert scene.tracker.shared.start == pytest.approx(50.0 - 30.2)

    def test_the_category_has_the_highest_sum_of_scores(self) -> None:
        assert TrackRecord(1, 1, 0.0, 0.0, 3, 3, 0.0, {"car": 0.9, "ship": 1.1, "bird": 0.4}).category == "ship"
        scene = Scene()
        for k, (name, score) in enumerate((("car", 0.9), ("ship", 0.6), ("ship", 0.5), ("car", 0.1))):
            pairs = scene.pairs(0.1 * k, HERE)
            told = scene.tracker(dataclasses.replace(pairs, category=(name,), score=torch.tensor([score])))
        assert told.category == ("ship",)
        assert scene.tracker.records[0].categories == pytest.approx({"car": 1.0, "ship": 1.1})

    def test_gates_lose_as_many_of_any_number_of_cameras(self) -> None:
        gates = Tracker(tracked_site(), dataclasses.replace(SLOW, gate=20.0)).gates
        assert chdtrc([2, 2, 4], gates.numpy()).tolist() == pytest.approx([float(chdtrc(4, 20.0))] * 3)

    def test_frames_are_turned_towards_what_is_beside_their_axis(self) -> None:
        aim = torch.tensor([[0.29, 0.31, 0.0, 0.1], [-0.29, 0.0, -0.5, 0.2]]).double()
        turn = _toward(aim)
        still = torch.eye(3).double()
        assert [torch.equal(turn[..., k], still) for k in range(4)] == [True, False, False, True]
        for k in (1, 2):
            ray = torch.cat([aim[:, k], torch.ones(1).double()])
            torch.testing.assert_close(turn[..., k] @ ray / ray.norm(), still[2])
            torch.testing.assert_close(turn[..., k] @ turn[..., k].T, still)
            torch.testing.assert_close(torch.linalg.cross(turn[0, :, k], turn[1, :, k]), turn[2, :, k])


class TestLooks:
    def test_samples_of_boxes_and_beyond(self) -> None:
        """Sixteen across a box; those of a ramp are its values there, and the border goes on beyond the image."""
        y, x = torch.meshgrid(torch.arange(60.0).double(), torch.arange(80.0).double(), indexing="ij")
        boxes = torch.tensor([[10.0, 20.0, 26.0, 36.0], [30.0, 10.0, 62.0, 18.0]]).double()
        for samples in (16, 24):
            beyond = (samples - 16) / 2
            found = _patches(2.0 * x + 100.0 * y, boxes, samples)
            for patch, (left, top, right, bottom) in zip(found, boxes.tolist(), strict=True):
                step = torch.arange(samples).double() - beyond + 0.5
                u, v = left + (right - left) / 16.0 * step, top + (bottom - top) / 16.0 * step
                torch.testing.assert_close(patch, 2.0 * u[None] + 100.0 * v[:, None])
        edge = _patches(x, torch.tensor([[-20.0, 10.0, -4.0, 26.0]]).double(), 16)
        assert edge.unique().tolist() == [0.0]

    def test_correlations_are_those_of_numpy(self) -> None:
        left, right = torch.rand(2, 50, 60, generator=torch.Generator().manual_seed(2)).double()
        left_boxes = torch.tensor([[5.0, 6, 21, 22], [30.0, 20, 54, 40]]).double()
        right_boxes = torch.tensor([[12.0, 9, 28, 25], [8.0, 20, 30, 44], [20.0, 20, 36, 36]]).double()
        found = appearance(left, left_boxes, right, right_boxes)
        own, wide = _patches(left, left_boxes, 16).numpy(), _patches(right, right_boxes, 24).numpy()
        for n in range(2):
            for m in range(3):
                parts = [wide[m, i : i + 16, j : j + 16] for i in range(9) for j in range(9)]
                best = max(np.corrcoef(own[n].ravel(), part.ravel())[0, 1] for part in parts)
                assert float(found[n, m]) == pytest.approx(best)
        flat = appearance(torch.full((50, 60), 3.0).double(), left_boxes, right, right_boxes)
        assert flat.tolist() == [[0.0] * 3] * 2
