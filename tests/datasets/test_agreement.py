"""What is stated of a recording is compared with its images, and true statements pass."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from moving_room import CAMERA, pose, write_recording

from toolkit.base.errors import SettingsError
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.base.options import validated
from toolkit.datasets import checks
from toolkit.datasets.agreement.findings import Contradictions, contradictions
from toolkit.datasets.agreement.given_poses import PoseAgreement, judge_given, sudden_steps
from toolkit.datasets.agreement.intrinsics import estimate_intrinsics
from toolkit.datasets.agreement.labels import label_finding
from toolkit.datasets.agreement.pairs import aligned_pair, aligned_pairs
from toolkit.datasets.agreement.refine import with_refined_intrinsics
from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.registry import describe
from toolkit.datasets.samples import SmallFrames, evenly_spaced
from toolkit.io.trajectories import write_tum
from toolkit.runs import modes
from toolkit.runs.modes import mode_of
from toolkit.runs.recordings import open_recording
from toolkit.runs.settings import RunSettings
from toolkit.slam.mapping.consensus import connected_segments

FRAMES, FPS = 40, 20.0
TIMES_S = np.arange(FRAMES) / FPS


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    return describe(
        "folder", write_recording(tmp_path_factory.mktemp("agreement") / "box", TIMES_S)
    )


def found(recording, **changes):
    return list(contradictions(RecordedDataset(replace(recording, **changes))).others)


def small(recording):
    return SmallFrames(RecordedDataset(recording))


def aligned_frames(frames):
    """Pairs of frames that are small already."""
    of_reach = SimpleNamespace(
        anchors=lambda reach: evenly_spaced(len(frames) - reach, 8), get=frames.__getitem__
    )
    return aligned_pairs(of_reach)


def with_board(frame):
    """A frame whose middle shows a textured board that moves to the right."""
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    x = (u - CAMERA.cx) / CAMERA.fx * 0.9 - 0.02 * (frame.index - 20)
    y = (v - CAMERA.cy) / CAMERA.fy * 0.9
    on = (np.abs(x) < 0.25) & (np.abs(y - 0.1) < 0.25)
    waves = np.sin(np.stack([23 * x, 31 * y, 17 * (x + y)], axis=-1)) * np.cos(9 * y)[..., None]
    rgb = np.where(on[..., None], 0.5 + 0.4 * waves, frame.rgb).astype(np.float32)
    return replace(frame, rgb=rgb, depth_m=np.where(on, np.float32(0.9), frame.depth_m))


def test_true_statements_pass(box):
    assert found(box) == []


@pytest.mark.parametrize("factor", [1.2, 1.05, 0.9])
def test_a_wrong_focal_length_is_named_with_the_right_one(box, factor):
    wrong = replace(CAMERA, fx=factor * CAMERA.fx, fy=factor * CAMERA.fy)
    (line,) = found(box, camera=wrong)
    right, stated = map(float, re.search(r"length of (\S+) instead of (\S+);", line).groups())
    assert right == pytest.approx(CAMERA.fx, rel=0.01) and stated == pytest.approx(
        wrong.fx, abs=0.1
    )


def test_a_wrong_principal_point_is_named_with_the_right_one(box):
    (line,) = found(box, camera=replace(CAMERA, cx=CAMERA.cx + 10.0))
    x, y = map(float, re.search(r"point at \((\S+), (\S+)\) instead", line).groups())
    assert (x, y) == pytest.approx((CAMERA.cx, CAMERA.cy), abs=0.5)


def test_distortion_that_is_not_stated_is_named(tmp_path):
    (line,) = found(describe("folder", write_recording(tmp_path / "bent", TIMES_S, k1=-0.2)))
    assert float(re.search(r"k1 = (\S+) ", line)[1]) == pytest.approx(-0.2, abs=0.03)


def test_depth_that_is_wrong_in_a_quarter_of_the_image_is_no_focal_length(box):
    dataset, wrong = RecordedDataset(box), []
    for frame in dataset:
        depth_m = frame.depth_m.copy()
        depth_m[36:, 48:] *= 1.02
        wrong.append(replace(frame, depth_m=depth_m))
    assert not estimate_intrinsics(list(aligned_frames(wrong))).noted.any()


def test_frames_that_overlap_are_one_observation(box):
    pairs = aligned_pairs(small(box))
    apart = [replace(p, first=40 * p.first, second=40 * p.first + 20) for p in pairs]
    overlapping = [replace(p, first=p.first, second=p.first + 40) for p in pairs]
    certain, doubtful = (estimate_intrinsics(found) for found in (apart, overlapping))
    np.testing.assert_array_equal(certain.values, doubtful.values)
    assert (doubtful.sigmas > 1.2 * certain.sigmas).any()


def test_a_board_that_moves_before_the_camera_is_no_focal_length(box):
    frames = [with_board(frame) for frame in RecordedDataset(box)]
    found = estimate_intrinsics(list(aligned_frames(frames)))
    assert found is None or not found.noted.any()


def test_intrinsics_are_refined_where_they_are_wrong(tmp_path, box):
    bent = describe("folder", write_recording(tmp_path / "bent", TIMES_S, k1=-0.2))
    wrong = replace(bent, camera=replace(CAMERA, fx=1.1 * CAMERA.fx, fy=1.1 * CAMERA.fy))
    refined = with_refined_intrinsics(wrong)
    assert refined.camera.fx == pytest.approx(CAMERA.fx, rel=0.01)
    assert refined.distortion[0] == pytest.approx(-0.2, abs=0.03)
    assert (
        "k1=-0." in refined.notes[-1] and f"stated: fx={wrong.camera.fx:.1f}" in refined.notes[-1]
    )
    right = with_refined_intrinsics(box)
    assert right.camera == box.camera and right.distortion is None
    assert "agree" in right.notes[-1]


@pytest.mark.parametrize("factor", [1.25, 0.9])
def test_the_unit_of_depth_is_compared_with_that_of_poses(box, factor):
    poses = box.ground_truth.T_world_camera.copy()
    poses[:, :3, 3] *= factor
    (line,) = found(box, ground_truth=Trajectory(TIMES_S, poses))
    assert float(re.search(r"multiplied by (\S+) ", line)[1]) == pytest.approx(factor, rel=0.02)
    scale = float(re.search(r"depth_scale (\S+) instead of 5000", line)[1])
    assert scale == pytest.approx(5000.0 / factor, rel=0.02)


def test_a_camera_that_stands_still_tells_no_unit(box):
    pairs = aligned_pairs(small(box))
    rng = np.random.default_rng(0)
    still = []
    for pair in pairs:
        T = pair.pose.T_second_first.copy()
        T[:3, 3] = 0.002 * rng.normal(size=3)
        still.append(replace(pair, pose=replace(pair.pose, T_second_first=T)))
    poses = box.ground_truth.T_world_camera.copy()
    poses[:, :3, 3] = 0.0
    for pair in still:
        # The given steps have the right length, and those by images an error of the same size.
        poses[pair.second, :3, 3] = poses[pair.first, :3, 3]
        poses[pair.second, :3, 3] -= poses[pair.second, :3, :3] @ (
            0.5 * pair.pose.T_second_first[:3, 3] + 0.001 * rng.normal(size=3)
        )
    assert judge_given(still, TIMES_S, Trajectory(TIMES_S, poses)).depth_factor == 1.0


@pytest.mark.parametrize("frames", [1, 3, -2])
def test_a_delay_of_poses_is_named(box, frames, tmp_path):
    delay_s = frames / FPS
    late = Trajectory(TIMES_S, np.array([pose(t - delay_s) for t in TIMES_S]))
    (line,) = found(box, ground_truth=late)
    option = float(re.search(r"--dataset.pose-delay (\S+)$", line)[1])
    assert option == pytest.approx(delay_s, abs=0.3 / FPS)
    assert found(box, ground_truth=late.delayed(delay_s)) == []


def test_pairs_that_are_aligned_by_a_period_off_are_no_delay_and_no_unit(box):
    pairs = aligned_pairs(small(box))
    longest = np.argsort([np.linalg.norm(p.pose.T_second_first[:3, 3]) for p in pairs])
    for number in longest[-len(pairs) // 5 :]:
        wrong = pairs[number].pose.T_second_first.copy()
        wrong[:3, 3] *= 3.0
        off = replace(pairs[number].pose, T_second_first=wrong)
        pairs[number] = replace(pairs[number], pose=off)
    assert judge_given(pairs, TIMES_S, box.ground_truth) == PoseAgreement()


@pytest.mark.parametrize("poses", ["slam", "given"])
def test_a_run_reports_what_contradicts_its_images(box, monkeypatch, poses):
    settings = validated(RunSettings, {"poses": poses})
    monkeypatch.setattr(modes, "contradictions", lambda _: Contradictions(others=("a line",)))
    assert "a line" in mode_of(settings).findings(RecordedDataset(box), [], settings)


def test_check_data_reports_it(box, monkeypatch):
    monkeypatch.setattr(checks, "contradictions", lambda _: Contradictions(others=("a line",)))
    short = replace(box, files=box.files[:3], readout_s=0.0)
    assert "a line" in checks.check_recording(short).faults


def test_a_jump_of_poses_is_named(box):
    poses = box.ground_truth.T_world_camera.copy()
    poses[25:, 0, 3] += 0.1
    (line,) = found(box, ground_truth=Trajectory(TIMES_S, poses))
    assert line.startswith("1 pose(s) jump") and "0025" in line


def test_a_camera_that_is_pushed_does_not_jump(box):
    # The pose is where the images are, however sudden the motion is.
    times_s = TIMES_S + np.where(np.arange(FRAMES) >= 25, 4.0, 0.0) / FPS
    given = Trajectory(TIMES_S, np.array([pose(t) for t in times_s]))
    (step,) = sudden_steps(given)
    assert step.index == 24
    frames = [*range(25), *range(29, FRAMES)]
    pushed = replace(
        box,
        files=tuple(
            replace(box.files[n], timestamp_s=t) for n, t in zip(frames, TIMES_S, strict=False)
        ),
        ground_truth=given,
    )
    assert not step.is_jump(aligned_pair(small(pushed), 24))


def test_without_depth_or_with_few_frames_nothing_is_said(box):
    colour = tuple(replace(files, depth=None) for files in box.files)
    assert found(box, files=colour) == []
    assert found(box, files=box.files[:2], camera=replace(CAMERA, fx=110.0, fy=110.0)) == []


def test_frames_that_cannot_be_read_are_left_out(box, tmp_path):
    damaged = tmp_path / "damaged.png"
    damaged.write_bytes(b"")
    files = (*box.files[:5], replace(box.files[5], rgb=damaged), *box.files[6:])
    pairs = aligned_pairs(small(replace(box, files=files)))
    assert pairs and not any(5 in (pair.first, pair.second) for pair in pairs)


def test_late_poses_are_used_with_the_delay(box, tmp_path):
    folder = write_recording(tmp_path / "late", TIMES_S)
    delay_s = 2 / FPS
    write_tum(
        folder / "trajectory.txt",
        Trajectory(TIMES_S, np.array([pose(t - delay_s) for t in TIMES_S])),
    )

    def opened(delay):
        values = {"dataset": {"kind": "folder", "path": str(folder), "pose_delay": delay}}
        return open_recording(validated(RunSettings, values), folder)

    dataset = opened(delay_s)
    assert len(dataset.ground_truth) == FRAMES - 2
    for time_s, T in zip(*vars(dataset.ground_truth).values(), strict=True):
        assert np.allclose(T, pose(time_s), atol=1e-4)
    with pytest.raises(SettingsError, match=r"--dataset.pose-delay 9 leaves no poses of late"):
        opened(9.0)


def patches(level, index):
    """Class ids [H, W] of patches of the walls."""
    T_world_camera = pose(TIMES_S[index])
    points = se3.transform_points(T_world_camera, level.points.reshape(-1, 3).astype(np.float64))
    x, y, z = np.floor(points / 0.9 + 0.1).astype(int).T + 4
    return (1 + x % 3 + 3 * (y % 3) + 9 * (z % 3)).reshape(level.points.shape[:2]).astype(np.int32)


def permuted(labels, index):
    return np.append(0, 1 + np.random.default_rng(index).permutation(27)).astype(np.int32)[labels]


def numbered_from_the_left(labels, index):
    ids, places = np.unique(labels.T, return_index=True)
    numbers = np.zeros(28, np.int32)
    numbers[ids[np.argsort(places)]] = np.arange(1, len(ids) + 1)
    return numbers[labels]


def partly_wrong(labels, index):
    generator = np.random.default_rng(index)
    segments, own = connected_segments(labels)
    wrong = np.where(generator.random(len(own)) < 0.2, generator.integers(1, 28, len(own)), own)
    return wrong[segments].astype(np.int32)


def label_line(pairs, change):
    named = []
    for pair in pairs:
        a, b = (
            change(patches(level, index), index)
            for level, index in zip(pair.levels, (pair.first, pair.second), strict=True)
        )
        named.append(replace(pair, labels=(a, b)))
    return label_finding(named)


def test_ids_that_change_between_frames_are_named(box):
    pairs = aligned_pairs(small(box))
    assert label_finding(pairs) is None  # without labels
    assert label_line(pairs, lambda labels, _: labels) is None
    assert label_line(pairs, partly_wrong) is None
    share = int(re.search(r"\((\d+)% of", label_line(pairs, permuted))[1])
    assert share == pytest.approx(96, abs=3)
    assert "--instances.kind folder" in label_line(pairs, numbered_from_the_left)
