"""Frames without depth are tracked against the map with depth priors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from toolkit.base.frame import Frame
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.base.options import as_plain, validated
from toolkit.datasets.images_only import ImagesOnly
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.depth.depth_priors.options import DepthPriorOptions, ScaleCorrectionOptions
from toolkit.depth.depth_priors.provider import (
    DepthKind,
    DepthPrior,
    PriorModel,
    PriorSet,
    ScaleScope,
)
from toolkit.depth.monocular.sequence import prior_correction
from toolkit.io.images import write_png
from toolkit.runs.building import build_slam
from toolkit.runs.evaluation.trajectory import absolute_trajectory_error
from toolkit.runs.settings import RunSettings, load_settings
from toolkit.slam.system import Slam

FRAMES, SIZE, STRIDE = 10, 2, 2
OPTIONS = DepthPriorOptions(
    size=SIZE, stride=STRIDE, correction=ScaleCorrectionOptions(grid=1, filter=False)
)


class Room:
    """A room as a dataset."""

    name, label_names = "room", None

    def __init__(self) -> None:
        self.frames, self.ground_truth = tiny_room(FRAMES, 80, 60)
        self.camera = self.frames[0].camera

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Frame:
        return self.frames[index]


class ScaledTruth:
    """True depth with another scale for each set but the first one."""

    joint, model = False, PriorModel("scaled truth")

    def __init__(self, room: Room, missing: int) -> None:
        self._room, self._missing = room, missing

    def predict(self, frames: Sequence[Frame]) -> PriorSet:
        def values(index: int) -> np.ndarray:
            number = index // (SIZE * STRIDE) * STRIDE + index % STRIDE
            scale = 1.0 if number == 0 else (1.7, 0.5)[number % 2]
            known = np.nan if index == self._missing else 1.0
            return (known * scale * self._room[index].depth_m).astype(np.float32)

        priors = tuple(
            DepthPrior(values(f.index), DepthKind.SCALED, ScaleScope.SET, self.model)
            for f in frames
        )
        return PriorSet(tuple(f.index for f in frames), priors)


@pytest.fixture(scope="module")
def room() -> Room:
    return Room()


def system(
    room: Room, tracker: str, missing: int = -1, masks: Path | None = None
) -> tuple[Slam, ImagesOnly]:
    values = as_plain(load_settings(preset="hier-slam-mono"))
    values["semantics"]["code"]["kind"] = "none"
    values["mapping"] |= {"first_iterations": 12, "iterations": 4}
    values["tracking"]["kind"] = tracker
    values["tracking"]["first_order"]["iterations"] = 25
    if masks is not None:
        values["instances"] |= {"kind": "folder", "path": masks}
        values["semantics"]["ignore"] = ["robot"]
    images = ImagesOnly(room)
    provider = ScaledTruth(room, missing)
    correction = prior_correction(images, provider, OPTIONS, needs_reference=False)
    settings = validated(RunSettings, values)
    return build_slam(images, settings, correction=correction), images


def test_frames_are_tracked_in_the_unit_of_the_first_set(room):
    slam, images = system(room, "dense")
    results = [slam.process_frame(frame) for frame in images]
    assert not any(result.lost for result in results)
    found = slam.finish().trajectory
    error = absolute_trajectory_error(found, room.ground_truth, "sim3")
    assert error.rmse_m < 0.1 * path_m(room.ground_truth)
    assert 0.6 < error.alignment.scale < 1.6  # those of the sets are 0.6 to 2


def path_m(trajectory: Trajectory) -> float:
    return float(np.linalg.norm(np.diff(trajectory.positions_m, axis=0), axis=1).sum())


@pytest.mark.parametrize("tracker", ["first-order", "dense"])
def test_a_frame_without_a_prior_is_lost_and_the_next_one_is_tracked(room, tracker):
    slam, images = system(room, tracker, missing=3)
    results = [slam.process_frame(images[index]) for index in range(5)]
    assert [result.lost for result in results] == [False, False, False, True, False]
    assert "0 pixels have depth" in results[3].reason


def test_priors_give_no_depth_to_what_is_ignored(room, tmp_path):
    ids = np.zeros((60, 80), np.uint8)
    ids[:, :30] = 1
    for index in range(FRAMES):
        write_png(tmp_path / f"{index:06d}.png", ids)
        np.savez(tmp_path / f"{index:06d}.npz", ids=[1], classes=["robot"])
    slam, images = system(room, "dense", masks=tmp_path)
    assert not any(slam.process_frame(images[index]).lost for index in range(6))
    assert len(slam.atlas.keyframes) > 1
    for keyframe in slam.atlas.keyframes:
        np.testing.assert_array_equal(keyframe.transient, ids == 1)
        assert not keyframe.depth_m[:, :30].any() and (keyframe.depth_m[:, 30:] > 0).all()
