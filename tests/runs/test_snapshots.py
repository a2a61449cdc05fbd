"""Snapshots of a run for viewers: written on request, complete, and without harm to the run."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.registry import open_dataset
from toolkit.runs.building import build_slam
from toolkit.runs.evaluation.timing import StageRecorder
from toolkit.runs.execution import run
from toolkit.runs.folder import RunFolder
from toolkit.runs.observers import ObservedRun, Observers
from toolkit.runs.progress import ProgressReader
from toolkit.runs.settings import RunSettings, dump_settings, load_settings
from toolkit.runs.snapshots import SnapshotWriter, unwatch, watch
from toolkit.scene.growing.options import GrowingSceneOptions
from toolkit.slam.mapping.options import KeyframePolicy, MapperOptions
from toolkit.slam.submaps.options import AllocationOptions, SubmapOptions

MAPPING = MapperOptions(
    first_iterations=4, iterations=1, final_iterations=1, keyframes=KeyframePolicy(interval=1)
)
SUBMAPS = SubmapOptions(allocation=AllocationOptions(min_keyframes=2, max_keyframes=3))
SETTINGS = RunSettings(mapping=MAPPING, submaps=SUBMAPS)
GRAPH = replace(SETTINGS, scene=GrowingSceneOptions(graph=True))


@dataclass
class Running:
    """A run whose frames are processed by the test, at the times of the test."""

    recording: Path
    path: Path
    settings: RunSettings = SETTINGS
    time_s: float = 0.0
    done: int = 0
    writer: SnapshotWriter = field(init=False)

    def __post_init__(self) -> None:
        dataset = DatasetOptions(kind="folder", path=self.recording)
        settings = replace(self.settings, dataset=dataset)
        self.folder = RunFolder.create(self.path, dump_settings(settings))
        self.frames = open_dataset("folder", self.recording)
        recorder = StageRecorder()
        self.slam = build_slam(self.frames, settings, self.folder, recorder)
        self.folder.check_taxonomy(self.slam.result().taxonomy)
        self.writer = SnapshotWriter(lambda: self.time_s)
        camera = self.frames.camera
        self.observers = Observers([self.writer])
        self.observers.started(ObservedRun("tiny", camera, self.folder, self.slam, recorder))

    def process(self, at_s: float, frames: int = 1) -> None:
        """Process frames at a time, and wait until a snapshot that was due is written."""
        self.time_s = at_s
        for index in range(self.done, self.done + frames):
            frame = self.frames[index]
            self.observers.frame_processed(frame, self.slam.process_frame(frame))
            if self.writer._pending is not None:
                self.writer._pending.exception()
        self.done += frames


@pytest.fixture
def running(tiny_recording, tmp_path):
    run = Running(tiny_recording, tmp_path / "run")
    yield run
    run.observers.close()


def test_a_run_that_nobody_watches_writes_nothing(running):
    running.process(0.0, 2)
    assert not running.folder.live.exists()


def test_a_snapshot_has_the_map_the_path_and_the_classes(running):
    watch(running.folder)
    running.process(0.0, 5)
    watch(running.folder)
    running.process(9.0)
    assert len(running.slam.atlas) > 1, "the test needs several submaps"
    seen = ProgressReader(running.path).read()
    slam = running.slam
    assert seen.next_frame == 6
    trajectory = slam.result().trajectory
    assert seen.indices == slam.result().frame_indices
    assert seen.T_world_camera == pytest.approx(trajectory.T_world_camera, abs=1e-9)
    assert [p.number for p in seen.parts] == list(range(len(slam.atlas)))
    for part in seen.parts:
        submap = slam.atlas.submap(part.number)
        assert part.T_world_submap == pytest.approx(submap.T_world_submap)
        assert np.array_equal(part.gaussians.means, submap.gaussians.means)
        assert np.array_equal(part.gaussians.features, submap.gaussians.features)
    assert {k.index for k in seen.keyframes} == set(slam.result().keyframe_indices)
    assert seen.keyframes[-1].rgb.shape == (3, 48, 64)
    assert (seen.decode(seen.parts[-1].gaussians).levels >= 0).any()
    assert seen.camera == running.frames.camera


def test_a_snapshot_has_the_doubtful_and_the_lost_frames(running):
    watch(running.folder)
    running.process(0.0, 5)
    path = running.slam.camera_path
    path._frames[2] = replace(path._frames[2], doubt="ambiguous")
    path.lost_frames[90] = "dark"
    watch(running.folder)
    running.process(9.0)
    seen = ProgressReader(running.path).read()
    assert (seen.doubtful, seen.lost) == ({path.indices[2]}, {90})


def test_snapshots_and_checkpoints_have_the_scene_graph(tiny_recording, tmp_path):
    run = Running(tiny_recording, tmp_path / "run", GRAPH)
    reader = ProgressReader(run.path)
    watch(run.folder)
    run.process(0.0, 4)
    assert reader.read().graph is None, "one keyframe makes no object"
    watch(run.folder)
    run.process(9.0)
    expected = run.slam.listener("scene").scene.content()
    assert len(expected["nodes"]) > 3
    seen = reader.read()
    assert seen.graph == expected
    points_m = run.slam.listener("scene").scene.snapshot().points_m
    assert set(seen.voxels_m) == set(points_m)
    assert all(np.array_equal(seen.voxels_m[n], points_m[n]) for n in points_m)
    run.folder.checkpoints.save(6, *run.slam.state())
    run.observers.close()
    assert ProgressReader(run.path).read().graph == expected


def test_snapshots_have_an_interval_and_end_with_the_viewer(running):
    written = []
    for at_s in (0.0, 1.0, 2.1, 13.0, 14.0):
        if at_s < 2.0:
            watch(running.folder)
        running.process(at_s)
        written.append((running.folder.snapshot / "metadata.json").stat().st_mtime_ns)
    assert written[0] == written[1] != written[2], "one snapshot in two seconds"
    assert written[2] == written[3] == written[4], "nobody has watched for ten seconds"


def test_the_map_may_change_while_a_snapshot_is_written(running):
    running.process(0.0)
    means_m = running.slam.atlas.gaussians.means
    before_m = means_m.clone()
    arrays, _ = running.writer._state(running.slam)
    means_m.add_(1.0)
    assert np.array_equal(arrays["atlas/active/gaussians/means"], before_m)


def test_a_run_that_is_watched_has_the_same_result(tiny_run, tmp_path, monkeypatch):
    """`tiny_run` was not watched."""

    class Watcher:
        def started(self, run):
            self.folder = run.folder
            watch(run.folder)

        def frame_processed(self, frame, result):
            found.append(self.folder.snapshot.is_dir())

        def finished(self, result):
            pass

        def close(self):
            pass

    monkeypatch.setattr("toolkit.runs.snapshots._EVERY_S", 0.0)
    found = []
    run(load_settings(tiny_run / "config.yaml"), tmp_path / "run", observers=[Watcher()])
    assert found[-1]
    for name in ("map.ply", "trajectory.txt", "loops.jsonl"):
        assert (tmp_path / "run" / name).read_bytes() == (tiny_run / name).read_bytes(), name


def test_an_older_checkpoint_does_not_replace_what_was_shown(running):
    reader = ProgressReader(running.path)
    watch(running.folder)
    running.process(0.0)
    running.folder.checkpoints.save(1, *running.slam.state())
    running.process(5.0)
    assert reader.read().next_frame == 2
    unwatch(running.folder)
    assert reader.read() is None
    running.process(10.0)
    running.folder.checkpoints.save(3, *running.slam.state())
    assert reader.read().next_frame == 3


def test_a_snapshot_that_is_replaced_while_it_is_read_is_read_later(running, monkeypatch):
    reader = ProgressReader(running.path)
    watch(running.folder)
    running.process(0.0)
    serials = iter((1, 2))
    monkeypatch.setattr("toolkit.runs.progress.read_serial", lambda _: next(serials))
    assert reader.read() is None
    monkeypatch.undo()
    assert reader.read().next_frame == 1


def test_a_full_disk_costs_the_snapshots_only(running, monkeypatch, caplog):
    def full(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr("toolkit.runs.snapshots.write_array_tree", full)
    watch(running.folder)
    with caplog.at_level(logging.WARNING, "toolkit"):
        for at_s in (0.0, 5.0, 10.0):
            running.process(at_s)
    assert caplog.text.count("no longer called: no space left") == 1
    assert running.slam.result().frame_indices == [0, 1, 2]


def test_the_end_of_the_run_removes_snapshots(running):
    watch(running.folder)
    running.process(0.0)
    assert running.folder.snapshot.is_dir()
    running.observers.close()
    assert not running.folder.live.exists()


def test_a_folder_without_write_access_is_followed_by_checkpoints(running, monkeypatch):
    def denied(*_, **__):
        raise PermissionError("read-only file system")

    monkeypatch.setattr(Path, "mkdir", denied)
    assert ProgressReader(running.path).read() is None
