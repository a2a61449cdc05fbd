"""The second start: what Open3D's odometry finds, when it is asked, and what comes of it."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from tracked_room import (
    Room,
    assert_same_place,
    blind_frame,
    distance_mm,
    frame_from_elsewhere,
    small_motion,
)

from toolkit.alignment.data import FrameLevel, ModelLevel
from toolkit.alignment.levels import intensity_of, model_level, view_level
from toolkit.errors import DependencyError
from toolkit.frame import Frame
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry.camera import Camera
from toolkit.rendering import RenderOptions, backend, render_surface
from toolkit.tracking import dense, odometry
from toolkit.tracking.dense import DenseTracker
from toolkit.tracking.odometry import frame_to_model
from toolkit.tracking.options import DenseOptions
from toolkit.tracking.result import Health

# A step of 15 cm and 15 degrees in these directions (of `small_motion`) is far too large for the
# tracker's own levels, and not for odometry, on every instruction set: of 300 directions those
# that are not near the edge of either's reach.
TOO_FAR = [81, 89, 230, 265]


def level_of(frame: Frame) -> FrameLevel:
    return FrameLevel(frame.camera, intensity_of(frame.rgb), torch.from_numpy(frame.depth_m))


def drawn(gaussians: GaussianCloud, camera: Camera) -> ModelLevel:
    """The map as the first camera sees it."""
    return model_level(
        view_level(render_surface(backend(), gaussians, camera, np.eye(4), RenderOptions(0.9)), 0.9)
    )


def started(room: Room, gaussians: GaussianCloud, start: str) -> DenseTracker:
    """A tracker that has placed the second frame, and knows how well frames fit."""
    tracker = DenseTracker(DenseOptions(start=start))
    tracker.first_pose(room.frames[0])
    assert not tracker.track(room.frames[1], gaussians).lost
    return tracker


def far_from(pose: NDArray[np.float64], direction: int) -> NDArray[np.float64]:
    return pose @ small_motion(direction, metres=0.15, degrees=15.0)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows by one whenever odometry is asked."""
    calls: list[int] = []

    def watched(*arguments):
        calls.append(1)
        return frame_to_model(*arguments)

    monkeypatch.setattr(dense, "frame_to_model", watched)
    return calls


@pytest.fixture
def without_open3d(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing():
        raise DependencyError("Open3D cannot be loaded")

    monkeypatch.setattr(odometry, "open3d", missing)


class TestOdometry:
    def test_it_finds_a_known_motion(self, room, gaussians):
        frame, pose = room.frames[2], room.T_map_camera[2]
        found = frame_to_model(drawn(gaussians, frame.camera), level_of(frame), np.eye(4))
        assert distance_mm(pose, np.eye(4)) > 30.0
        assert_same_place(found, pose, mm=4.0, deg=0.1)

    def test_nothing_to_align_is_no_answer(self, room, gaussians):
        frame = room.frames[1]
        view = drawn(gaussians, frame.camera)
        empty = drawn(GaussianCloud.empty(), frame.camera)
        assert frame_to_model(view, level_of(blind_frame(frame)), np.eye(4)) is None
        assert frame_to_model(empty, level_of(frame), np.eye(4)) is None

    @pytest.mark.parametrize("size", [(1, 1), (2, 3), (9, 7)])
    def test_a_plane_of_a_few_pixels_is_no_answer(self, size):
        camera = Camera(8.0, 8.0, 1.0, 1.0, *size)
        level = FrameLevel(camera, torch.ones(size[1], size[0]), torch.ones(size[1], size[0]))
        assert frame_to_model(model_level(level), level, np.eye(4)) is None

    def test_the_same_bits_on_several_threads(self):
        """In a process of its own, where Open3D has not chosen its threads yet."""
        program = (
            "import sys\n"
            f"sys.path[:0] = {[str(folder) for folder in Path(__file__).parents[:2]]!r}\n"
            "import numpy as np\n"
            "from test_odometry_start import level_of\n"
            "from tracked_room import first_steps\n"
            "from toolkit.alignment.levels import model_level\n"
            "from toolkit.tracking.odometry import frame_to_model\n"
            "a, b = (level_of(f) for f in first_steps(2).frames)\n"
            "view = model_level(a)\n"
            "print(len({frame_to_model(view, b, np.eye(4)).tobytes() for _ in range(8)}))\n"
        )
        root = Path(__file__).parents[2]
        environment = os.environ | {"OMP_NUM_THREADS": "2", "PYTHONPATH": str(root)}
        done = subprocess.run(
            [sys.executable, "-c", program], env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        assert done.stdout.strip() == "1"


class TestSecondStart:
    @pytest.mark.parametrize("direction", TOO_FAR)
    def test_it_places_frames_that_the_first_start_does_not(self, room, gaussians, direction):
        pose = room.T_map_camera[1]
        start = far_from(pose, direction)
        alone = started(room, gaussians, "velocity").locate(room.frames[1], gaussians, start)
        assert distance_mm(alone.T_map_camera, pose) > 50.0
        found = started(room, gaussians, "auto").locate(room.frames[1], gaussians, start)
        assert not found.lost
        assert_same_place(found.T_map_camera, pose, mm=1.5, deg=0.08)
        assert found.renders > alone.renders and found.iterations > alone.iterations

    def test_frames_that_fit_do_not_ask_for_it(self, room, gaussians, asked):
        plain, auto = (started(room, gaussians, start) for start in ("velocity", "auto"))
        for frame in room.frames[2:]:
            one, other = (tracker.track(frame, gaussians) for tracker in (plain, auto))
            assert one.T_map_camera.tobytes() == other.T_map_camera.tobytes()
        assert not asked

    def test_both_ask_always_and_lose_nothing(self, room, gaussians, asked):
        both = started(room, gaussians, "both")
        for frame, pose in zip(room.frames[2:], room.T_map_camera[2:], strict=True):
            result = both.track(frame, gaussians)
            assert_same_place(result.T_map_camera, pose, mm=3.0, deg=0.1)
        assert len(asked) == len(room.frames) - 1

    def test_what_is_elsewhere_stays_lost(self, room, gaussians, asked):
        result = started(room, gaussians, "auto").track(
            frame_from_elsewhere(room.frames[2]), gaussians
        )
        assert asked and result.lost

    def test_a_worse_answer_is_not_taken(self, room, gaussians, monkeypatch):
        wrong = small_motion(1, metres=2.0, degrees=90.0)
        monkeypatch.setattr(dense, "frame_to_model", lambda *_: wrong)
        result = started(room, gaussians, "both").track(room.frames[2], gaussians)
        assert not result.lost
        assert_same_place(result.T_map_camera, room.T_map_camera[2], mm=1.5, deg=0.08)

    def test_a_restored_tracker_goes_on_with_the_same_bits(self, room, gaussians, asked):
        tracker = started(room, gaussians, "both")
        other = DenseTracker(DenseOptions(start="both"))
        other.restore({name: array.copy() for name, array in tracker.state().items()})
        for frame in room.frames[2:4]:
            here, there = tracker.track(frame, gaussians), other.track(frame, gaussians)
            assert here.T_map_camera.tobytes() == there.T_map_camera.tobytes()
        assert len(asked) == 5

    def test_one_level_is_enough(self, room, gaussians):
        """Odometry then uses the finest level, and rescues a start that one level does not."""
        pose, found = room.T_map_camera[1], {}
        start = pose @ small_motion(TOO_FAR[1], metres=0.08, degrees=8.0)
        for mode in ("velocity", "both"):
            tracker = DenseTracker(DenseOptions(levels=1, start=mode))
            tracker.first_pose(room.frames[0])
            found[mode] = tracker.locate(room.frames[1], gaussians, start).T_map_camera
        assert distance_mm(found["velocity"], pose) > 50.0
        assert_same_place(found["both"], pose, mm=1.5, deg=0.08)


@pytest.mark.usefixtures("without_open3d")
class TestWithoutOpen3d:
    def test_the_other_searches_remain(self, room, gaussians, caplog):
        elsewhere = frame_from_elsewhere(room.frames[2])
        with caplog.at_level(logging.INFO, "toolkit"):
            result = started(room, gaussians, "auto").track(elsewhere, gaussians)
        assert result.health is not Health.GOOD
        assert (
            "Odometry of frame 2 is not available" in caplog.text
            and "Open3D cannot be loaded" in caplog.text
        )

    def test_both_without_open3d_is_an_error(self, room, gaussians):
        tracker = DenseTracker(DenseOptions(start="both"))
        tracker.first_pose(room.frames[0])
        with pytest.raises(DependencyError, match="Open3D"):
            tracker.track(room.frames[1], gaussians)
