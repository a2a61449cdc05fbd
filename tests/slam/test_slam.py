"""The whole method on a small room: path, map, lost frames, and reproducibility."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from slam_room import FEW, SlamRoom, fed, fingerprint, new_semantic_slam, new_slam
from threadpoolctl import threadpool_info, threadpool_limits

from toolkit.base.frame import Frame, NullRecorder
from toolkit.base.geometry import se3
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.runs.evaluation.timing import StageRecorder
from toolkit.runs.folder import RunFolder
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.mapping.options import MapperOptions
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.system import Slam
from toolkit.slam.tracking.dense import DenseTracker
from toolkit.slam.tracking.first_order_tracker import FirstOrderTracker
from toolkit.slam.tracking.given import GivenPoses
from toolkit.slam.tracking.options import FirstOrderOptions
from toolkit.splatting.rendering import render


def errors_m(slam: Slam, room: SlamRoom) -> np.ndarray:
    """Distance of every tracked camera from the truth; both start at the first camera."""
    path = slam.result().trajectory
    true = np.stack([room.truth.at(t) for t in path.timestamps_s])
    return np.linalg.norm(path.positions_m - true[:, :3, 3], axis=1)


def blas_threads() -> set[int]:
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


class BlasRecorder(NullRecorder):
    """Keeps the numbers of threads that BLAS may use in any stage."""

    def __init__(self) -> None:
        self.threads: set[int] = set()

    def timed(self, stage: str) -> AbstractContextManager[None]:
        self.threads |= blas_threads()
        return super().timed(stage)


def blind(frame: Frame) -> Frame:
    return replace(frame, depth_m=np.zeros_like(frame.depth_m))


class TestPath:
    def test_it_follows_the_truth(self, room):
        slam = new_slam()
        results = fed(slam, room.frames)
        assert not slam.result().lost_frames and not any(r.lost for r in results)
        assert slam.result().frame_indices == list(range(14))
        assert np.sqrt((errors_m(slam, room) ** 2).mean()) < 0.0016
        assert room.truth.path_length_m > 0.2, "the camera does move"
        length_m = slam.result().trajectory.path_length_m
        assert length_m == pytest.approx(room.truth.path_length_m, rel=0.01)

    def test_keyframes_placed_by_earlier_ones_come_nearer_the_truth(self, room):
        rms_m = {}
        for placed in (True, False):
            slam = new_slam(placed=placed)
            fed(slam, room.frames)
            rms_m[placed] = np.sqrt((errors_m(slam, room) ** 2).mean())
        assert rms_m[True] < 0.9 * rms_m[False]

    def test_the_map_shows_the_room(self, room):
        slam = new_slam()
        fed(slam, room.frames)
        slam.finish()
        frame, pose = room.frames[7], slam.result().trajectory.T_world_camera[7]
        drawn = render(slam.result().gaussians, frame.camera, se3.inverse(pose))
        psnr_db = -10 * np.log10(((drawn.colour.numpy() - frame.rgb) ** 2).mean())
        assert psnr_db > 34.0

    def test_the_first_frame_starts_map_and_path(self, room):
        slam = new_slam()
        first = slam.process_frame(room.frames[0])
        assert np.array_equal(first.T_map_camera, np.eye(4))
        assert first.tracking is None and first.mapping.seeded > 0

    def test_given_poses_are_taken_as_they_are(self, room):
        slam = Slam(FrontEnd(GivenPoses(room.truth)), Mapper(FEW))
        fed(slam, room.frames[:6])
        assert np.allclose(slam.result().trajectory.T_world_camera, room.truth.T_world_camera[:6])

    def test_the_first_order_tracker_fits_in(self, room):
        slam = Slam(FrontEnd(FirstOrderTracker(FirstOrderOptions(iterations=15))), Mapper(FEW))
        results = fed(slam, room.frames[:3])
        assert [r.tracking.renders for r in results[1:]] == [16, 16]

    def test_the_path_moves_with_its_keyframes(self, room):
        """Bundle adjustment and loops move keyframes; frames between must follow."""
        slam = new_slam()
        fed(slam, room.frames[:6])
        before = slam.result().trajectory.T_world_camera
        move = se3.exp(np.array([0.1, 0.2, 0.3, 0.1, 0.0, 0.2]))
        for keyframe in slam.atlas.keyframes:
            keyframe.T_map_camera = move @ keyframe.T_map_camera
        assert np.allclose(slam.result().trajectory.T_world_camera, move @ before)

    def test_stages_are_timed_without_a_change(self, room):
        watch = StageRecorder()
        watched = Slam(
            FrontEnd(DenseTracker(recorder=watch)),
            Mapper(FEW, np.random.default_rng(0), recorder=watch),
            recorder=watch,
        )
        plain = new_slam(placed=False)
        for slam in (watched, plain):
            fed(slam, room.frames[:6])
        assert fingerprint(watched) == fingerprint(plain)

    def test_colours_fitted_at_centres_keep_the_path_straight(self):
        """Fitted where they are drawn, they lag behind the camera: 2.0 mm against 0.4."""
        frames, truth = tiny_room(14, 160, 120)
        T_first_world = se3.inverse(truth.T_world_camera[0])
        errors = {}
        for centred in (True, False):
            options = MapperOptions(iterations=6, first_iterations=15, centred=centred)
            slam = Slam(FrontEnd(DenseTracker()), Mapper(options, np.random.default_rng(0)))
            fed(slam, frames)
            away = slam.result().trajectory.T_world_camera - T_first_world @ truth.T_world_camera
            errors[centred] = float(np.sqrt((away[:, :3, 3] ** 2).sum(axis=1).mean()))
        assert errors[True] < 1e-3
        assert errors[True] < 0.5 * errors[False]


def test_an_empty_atlas_is_not_replaced():
    mapper = Mapper(FEW)
    atlas = Atlas(mapper.first_submap())
    atlas.load_map([])
    assert len(atlas) == 0
    assert Slam(FrontEnd(DenseTracker()), mapper, atlas=atlas).atlas is atlas


def test_without_a_map_there_is_nothing_to_finish(room):
    slam = new_slam()
    slam.process_frame(blind(room.frames[0]))
    slam.finish()
    assert len(slam.result().gaussians) == 0 and list(slam.result().lost_frames) == [0]


class TestHeldOut:
    def test_held_out_frames_are_tracked_and_not_mapped(self, room):
        slam = new_slam()
        results = fed(slam, room.frames, hold_out=2)
        assert all(r.mapping is None for r in results[1::2])
        assert all(k.index % 2 == 0 for k in slam.atlas.keyframes)
        assert len(slam.atlas.keyframes) > 1
        assert slam.result().frame_indices == list(range(14))

    def test_a_held_out_frame_cannot_start_the_map(self, room):
        slam = new_slam()
        assert slam.process_frame(room.frames[0], may_map=False).lost
        assert not slam.process_frame(room.frames[1]).lost
        assert slam.atlas.keyframes[0].index == 1


class TestLost:
    def test_a_lost_frame_is_reported_and_not_mapped(self, room):
        slam = new_slam()
        fed(slam, room.frames[:5])
        before = fingerprint(slam)
        result = slam.process_frame(blind(room.frames[5]))
        assert result.lost and result.T_map_camera is None
        assert result.tracking.reason and result.mapping is None
        assert list(slam.result().lost_frames) == [5]
        after = fingerprint(slam)
        changed = {name for name in before if before[name] != after[name]}
        assert not {name for name in changed if name.startswith(("mapper/", "atlas/"))}

    def test_it_goes_on_after_lost_frames(self, room):
        slam = new_slam()
        frames = [blind(f) if f.index in (5, 6) else f for f in room.frames]
        fed(slam, frames)
        assert list(slam.result().lost_frames) == [5, 6]
        assert slam.result().frame_indices == [0, 1, 2, 3, 4, 7, 8, 9, 10, 11, 12, 13]
        assert errors_m(slam, room).max() < 0.02

    def test_given_poses_with_a_gap_lose_that_frame(self, room):
        gap = room.truth.associated_to(np.delete(room.truth.timestamps_s, 3), 1e-6)
        slam = Slam(FrontEnd(GivenPoses(gap)), Mapper(FEW))
        fed(slam, room.frames[:6])
        assert list(slam.result().lost_frames) == [3]


class TestSameBits:
    def test_two_runs_with_one_seed_are_identical(self, room):
        prints = []
        for seed in (0, 0, 1):
            slam = new_slam(seed)
            fed(slam, room.frames[:10])
            slam.finish()
            prints.append(fingerprint(slam))
        assert prints[0] == prints[1]
        assert prints[0] != prints[2], "the seed has a say"

    @pytest.mark.parametrize("stop", [1, 5, 8, 10])
    def test_a_resumed_run_is_identical(self, room, tmp_path, stop):
        """Through a checkpoint on disk, at a keyframe or between, beside a lost frame."""
        frames = [blind(f) if f.index == 7 else f for f in room.frames[:10]]
        straight = new_slam()
        fed(straight, frames)
        interrupted = new_slam()
        fed(interrupted, frames[:stop])
        folder = RunFolder.create(tmp_path / "run", "seed: 0\n")
        folder.checkpoints.save(stop, *interrupted.state())
        checkpoint = RunFolder.open(tmp_path / "run").checkpoints.load()
        resumed = new_slam(seed=77)
        resumed.restore(checkpoint.arrays, checkpoint.values)
        fed(resumed, frames[checkpoint.next_frame :])
        for slam in (straight, resumed):
            slam.finish()
        assert fingerprint(resumed) == fingerprint(straight)

    @pytest.mark.parametrize("kind", ["recorded", "geometric"])
    def test_a_resumed_run_with_semantics_is_identical(self, room, tmp_path, kind):
        """Features, network, and what the segmenter remembers."""
        frames = room.frames[:11]
        straight, interrupted = new_semantic_slam(kind), new_semantic_slam(kind)
        fed(straight, frames)
        fed(interrupted, frames[:6])
        folder = RunFolder.create(tmp_path / "run", "seed: 0\n")
        folder.checkpoints.save(6, *interrupted.state())
        checkpoint = RunFolder.open(tmp_path / "run").checkpoints.load()
        resumed = new_semantic_slam(kind, seed=77)
        resumed.restore(checkpoint.arrays, checkpoint.values)
        fed(resumed, frames[6:])
        for slam in (straight, resumed):
            slam.finish()
        assert fingerprint(resumed) == fingerprint(straight)
        assert straight.result().gaussians.features.abs().max() > 1.0

    def test_saving_often_changes_nothing(self, room):
        plain, saved = new_slam(), new_slam()
        fed(plain, room.frames[:8])
        for frame in room.frames[:8]:
            saved.process_frame(frame)
            saved.state()
        assert fingerprint(saved) == fingerprint(plain)

    def test_two_threads_repeat_themselves(self, tmp_path):
        """In processes of their own, since a thread count is fixed when one starts."""
        program = (
            "import hashlib, sys\n"
            f"sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
            "from slam_room import fed, fingerprint, first_steps, new_slam\n"
            "import torch\n"
            "assert torch.get_num_threads() == 2\n"
            "room = first_steps(5)\n"
            "for _ in range(2):\n"
            "    slam = new_slam()\n"
            "    fed(slam, room.frames)\n"
            "    slam.finish()\n"
            "    found = sorted(fingerprint(slam).items())\n"
            "    print(hashlib.sha256(repr(found).encode()).hexdigest())\n"
        )
        root = Path(__file__).parents[2]
        environment = os.environ | {"OMP_NUM_THREADS": "2", "PYTHONPATH": str(root)}
        done = subprocess.run(
            [sys.executable, "-c", program],
            env=environment,
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        first, second = done.stdout.split()
        assert first == second


class TestExposures:
    def test_no_frame_is_no_path_and_no_exposure(self):
        assert len(new_slam().result().trajectory) == 0
        assert new_slam().result().exposures == []

    def test_exposures_belong_to_frames(self, room):
        slam = new_slam()
        fed(slam, room.frames[:3])
        exposures = slam.result().exposures
        assert len(exposures) == 3
        assert np.allclose([(e.gain, e.bias) for e in exposures], [1.0, 0.0], atol=0.05)


def test_blas_has_one_thread_while_frames_are_processed_and_its_own_number_afterwards():
    """Its waiting threads would take cores from the kernels."""
    recorder = BlasRecorder()
    frames, _ = tiny_room(2, 64, 48)
    slam = Slam(FrontEnd(DenseTracker()), Mapper(FEW, np.random.default_rng(0)), recorder=recorder)
    with threadpool_limits(2, "blas"):
        before = blas_threads()
        fed(slam, frames)
        slam.finish()
        assert 2 in before and blas_threads() == before
    assert recorder.threads == {1}
