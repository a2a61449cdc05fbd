"""The benchmark of motion: which frames each case shows, and what its truth is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.accuracy.motion_cases import (
    CASES,
    INTERRUPTIONS,
    CaseDataset,
    MixedDataset,
    Selection,
    cases_of,
    mirrored_later,
    one_after_another,
    unrelated_photos,
    with_blank_wall,
)
from toolkit.base.geometry import se3
from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.registry import describe

TIMES_S = 5.0 + np.arange(300) / 30.0


def select(case: str, seed: int = 0) -> Selection:
    return (CASES | INTERRUPTIONS)[case](TIMES_S, np.random.default_rng(seed))


def case_of(tiny_recording: Path, case: str) -> CaseDataset:
    return CaseDataset(describe("folder", tiny_recording), None, case)


def opened(tiny_recording: Path) -> RecordedDataset:
    return RecordedDataset(describe("folder", tiny_recording))


@pytest.mark.parametrize("case", CASES | INTERRUPTIONS)
def test_frames_are_in_order_and_their_times_increase(case: str) -> None:
    selection = select(case)
    assert selection.indices[0] == 0
    assert (np.diff(selection.indices) >= 0).all()
    assert (np.diff(selection.timestamps_s) > 0).all()
    assert len(selection.indices) == len(selection.timestamps_s)


def test_frames_that_are_left_out() -> None:
    np.testing.assert_array_equal(select("stride 16").indices, np.arange(0, 300, 16))
    assert len(select("30 % dropped").indices) == pytest.approx(210, abs=25)
    other = select("30 % dropped", seed=1).indices
    assert set(select("30 % dropped").indices) != set(other)
    steps = np.diff(select("bursts dropped").indices)
    assert steps[steps > 1].tolist() == [16] * 5
    steps = np.diff(select("jump of 100").indices)
    assert steps[steps > 1].tolist() == [101]


def test_times_of_kept_frames_are_those_of_the_recording() -> None:
    for case in ("stride 8", "30 % dropped", "jump of 50", "covered", "blur"):
        selection = select(case)
        np.testing.assert_array_equal(selection.timestamps_s, TIMES_S[selection.indices])


def test_a_frozen_stream_shows_one_frame_while_time_goes_on() -> None:
    selection = select("frozen")
    assert selection.indices[149:163].tolist() == [149, *[150] * 11, 161, 162]
    np.testing.assert_array_equal(selection.timestamps_s, TIMES_S)


def test_interruptions_take_a_second() -> None:
    assert len(select("black").covered) == 30
    assert np.diff(select("pause").timestamps_s).max() == pytest.approx(1.0, abs=0.04)


def test_repeated_frames_come_halfway_to_the_next() -> None:
    selection = select("repeated")
    assert selection.indices[:4].tolist() == [0, 0, 1, 1]
    np.testing.assert_allclose(np.diff(selection.timestamps_s), 1 / 60, rtol=1e-9)


@pytest.mark.parametrize(("case", "factor"), [("half speed", 2.0), ("double speed", 0.5)])
def test_speed_scales_times_and_readout(case: str, factor: float) -> None:
    selection = select(case)
    np.testing.assert_allclose(np.diff(selection.timestamps_s), factor / 30, rtol=1e-9)
    assert (len(selection.indices), selection.time_factor) == (300, factor)


def test_jumps_leave_out_at_most_half_of_a_sequence() -> None:
    jumps = {n: [c for c in cases_of(n) if c.startswith("jump")] for n in (51, 120, 600)}
    assert jumps[51] == ["jump of 25"]
    assert jumps[120] == ["jump of 50"]
    assert jumps[600] == ["jump of 50", "jump of 100", "jump of 200"]
    assert set(CASES) - set(cases_of(600)) == {"jump of 25"}


def test_a_case_shows_the_frames_and_poses_of_the_recording(tiny_recording: Path) -> None:
    recording, dataset = opened(tiny_recording), case_of(tiny_recording, "stride 2")
    assert recording.ground_truth is not None and dataset.ground_truth is not None
    assert (len(dataset), list(dataset.truth)) == (3, [0, 1, 2])
    for place, frame in enumerate(dataset):
        original = recording[2 * place]
        assert (frame.index, frame.timestamp_s) == (place, original.timestamp_s)
        np.testing.assert_array_equal(frame.rgb, original.rgb)
        pose = recording.ground_truth.T_world_camera[2 * place]
        np.testing.assert_array_equal(dataset.truth[place], pose)
        np.testing.assert_array_equal(dataset.ground_truth.T_world_camera[place], pose)


def test_repeated_frames_have_the_pose_of_their_image(tiny_recording: Path) -> None:
    dataset = case_of(tiny_recording, "repeated")
    np.testing.assert_array_equal(dataset[6].rgb, dataset[7].rgb)
    np.testing.assert_array_equal(dataset.truth[6], dataset.truth[7])
    assert not np.array_equal(dataset.truth[7], dataset.truth[8])


def test_covered_frames_are_black_and_without_depth(tiny_recording: Path) -> None:
    dataset = case_of(tiny_recording, "covered")
    assert dataset[2].rgb.any() and dataset[2].depth_m.any()
    assert not dataset[3].rgb.any() and not dataset[3].depth_m.any()


def test_blurred_frames_lose_contrast_but_no_depth(tiny_recording: Path) -> None:
    dataset = case_of(tiny_recording, "blur")
    dataset._selection = Selection(np.arange(6), np.arange(6.0), blurred=frozenset({4}))
    original = opened(tiny_recording)
    np.testing.assert_array_equal(dataset[3].rgb, original[3].rgb)
    assert np.abs(np.diff(dataset[4].rgb, axis=1)).mean() < 0.7 * np.abs(
        np.diff(original[4].rgb, axis=1)
    ).mean()  # fmt: skip
    np.testing.assert_array_equal(dataset[4].depth_m, original[4].depth_m)
    assert select("blur").blurred == {i for i in range(300) if (i // 10) % 3 == 1}


def test_the_readout_is_scaled_with_the_times(tiny_recording: Path) -> None:
    from dataclasses import replace

    recording = replace(describe("folder", tiny_recording), readout_s=0.02)
    assert CaseDataset(recording, None, "half speed").readout_s == pytest.approx(0.04)
    assert CaseDataset(recording, None, "stride 4").readout_s == pytest.approx(0.02)


def test_unrelated_photos_show_another_scene_each_time(tiny_recording: Path) -> None:
    scenes = [opened(tiny_recording) for _ in range(3)]
    mixed = unrelated_photos(scenes, each=2)
    assert mixed.scenes == [0, 1, 2, 0, 1, 2]
    assert [frame.index for frame in mixed] == list(range(6))
    assert (np.diff([frame.timestamp_s for frame in mixed]) > 0).all()
    np.testing.assert_array_equal(mixed[3].rgb, scenes[0][5].rgb)
    with pytest.raises(IndexError):
        mixed[6]


def test_a_wall_has_no_texture_no_truth_and_ends(tiny_recording: Path) -> None:
    mixed = with_blank_wall(opened(tiny_recording))
    assert mixed.scenes == [0] * 3 + [MixedDataset.WALL] * 100 + [0] * 3
    assert set(mixed.truth) == {0, 1, 2, 103, 104, 105}
    wall = mixed[50]
    assert np.abs(wall.rgb - 0.7).max() < 0.1
    assert np.abs(wall.depth_m - 1.0).max() < 0.1
    np.testing.assert_array_equal(mixed[103].rgb, opened(tiny_recording)[3].rgb)


def test_the_second_half_is_mirrored_with_its_poses(tiny_recording: Path) -> None:
    recording = opened(tiny_recording)
    mixed = mirrored_later(recording)
    assert mixed.scenes == [0, 0, 0, 1, 1, 1]
    np.testing.assert_array_equal(mixed[2].rgb, recording[2].rgb)
    np.testing.assert_array_equal(mixed[3].rgb, recording[3].rgb[:, ::-1])
    np.testing.assert_allclose(mixed[3].depth_m, recording[3].depth_m[:, ::-1], rtol=1e-6)
    # A point to the right of one image is to the left of the mirrored one.
    assert recording.ground_truth is not None
    T_world_camera = recording.ground_truth.T_world_camera
    flip = np.array([-1.0, 1.0, 1.0])
    point = np.array([0.3, 0.1, 2.0])
    true = se3.transform_points(se3.inverse(T_world_camera[5]) @ T_world_camera[3], point)
    found = se3.transform_points(se3.inverse(mixed.truth[5]) @ mixed.truth[3], flip * point)
    np.testing.assert_allclose(found, flip * true, atol=1e-12)


def test_two_recordings_follow_each_other(tiny_recording: Path) -> None:
    mixed = one_after_another(opened(tiny_recording), opened(tiny_recording))
    assert mixed.scenes == [0, 0, 0, 1, 1, 1]
    np.testing.assert_array_equal(mixed.truth[3], mixed.truth[0])
