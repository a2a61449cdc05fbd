"""Following a run in progress by its checkpoints."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from toolkit.errors import RunFolderError
from toolkit.io.splats import read_splats
from toolkit.runs.finished import load_run
from toolkit.viewer.live import LiveRun
from toolkit.viewer.options import ShownContent


@pytest.fixture
def running(resumable_run, tmp_path):
    """The folder of a run that has saved its last checkpoint, but has no results."""
    path = tmp_path / "running"
    shutil.copytree(resumable_run, path)
    for name in ("map.ply", "frames.json", "trajectory.txt", "metrics.json", "report.html"):
        (path / name).unlink()
    return path


def test_a_checkpoint_shows_map_cameras_and_classes(running, tiny_run):
    live = LiveRun(running, ShownContent(images=2))
    scene = live.poll()
    finished = load_run(tiny_run)
    assert scene.title == "running, frame 6"
    assert len(scene.splats) > 0.5 * len(finished.gaussians)
    assert np.abs(scene.path - finished.trajectory.T_world_camera).max() < 0.05
    assert [k.index for k in scene.keyframes] == finished.keyframes
    assert sum(k.image is not None for k in scene.keyframes) <= 2
    labels = read_splats(tiny_run / "map.ply").labels
    seen = {scene.tree.nodes[i].path for i in np.unique(scene.splats.levels) if i >= 0}
    known = {finished.taxonomy.nodes[i].path for i in np.unique(labels.levels) if i >= 0}
    assert seen & known
    assert live.poll() is None, "there is no newer checkpoint"
    assert not live.finished


def test_the_finished_run_replaces_the_checkpoint(running, tiny_run):
    live = LiveRun(running, ShownContent())
    live.poll()
    shutil.copytree(tiny_run, running, dirs_exist_ok=True)
    scene = live.poll()
    assert scene.title == "running" and live.finished
    assert scene.total == len(load_run(tiny_run).gaussians)


def test_a_run_without_checkpoint_shows_nothing_yet(running):
    shutil.rmtree(running / "checkpoint")
    assert LiveRun(running, ShownContent()).poll() is None


def test_a_checkpoint_that_is_being_replaced_is_read_later(running):
    newest = next((running / "checkpoint").iterdir())
    arrays = newest / "arrays.npz"
    kept = arrays.read_bytes()
    arrays.unlink()
    live = LiveRun(running, ShownContent())
    assert live.poll() is None
    arrays.write_bytes(kept)
    assert live.poll() is not None


def test_a_checkpoint_of_another_version_is_reported(running):
    file = next((running / "checkpoint").iterdir()) / "metadata.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"format": 99}))
    with pytest.raises(RunFolderError, match="format 99"):
        LiveRun(running, ShownContent()).poll()


def test_a_folder_without_a_run_is_reported(tmp_path):
    with pytest.raises(RunFolderError, match="config"):
        LiveRun(tmp_path, ShownContent())
