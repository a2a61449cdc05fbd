"""Following a run in progress by its checkpoints, and what the server shows of it."""

from __future__ import annotations

import json
import shutil
import time
from dataclasses import replace

import numpy as np
import pytest
from painted_scenes import two_panels

from toolkit.base.errors import RunFolderError
from toolkit.io.addresses import bind
from toolkit.io.splats import read_splats
from toolkit.runs.maps.finished import load_run
from toolkit.tools.viewer.live import LiveRun, follow
from toolkit.tools.viewer.options import ShownContent
from toolkit.tools.viewer.server import MapServer
from toolkit.tools.viewer.streaming import WholeMap


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


@pytest.fixture
def server():
    started = MapServer(bind("127.0.0.1", 0))
    yield started
    started.stop()


class Steps:
    """A run whose states are scenes, None for no news, or errors; the last one is finished."""

    def __init__(self, server: MapServer, *states: object, takes_s: float = 0.0) -> None:
        self.finished = False
        self._server, self._states, self._takes_s = server, list(states), takes_s
        self.seen: list[tuple[int, str, bool]] = []
        self.waits_s: list[float] = []

    def poll(self):
        state = self._states.pop(0)
        self.finished = not self._states
        time.sleep(self._takes_s)
        if isinstance(state, Exception):
            raise state
        return state

    def wait(self, seconds: float) -> None:
        self.waits_s.append(seconds)
        state = self._server.state
        self.seen.append((state.version, state.message, state.finished))

    def followed(self) -> None:
        follow(self, self._server, WholeMap, self.wait)


def test_a_server_follows_a_run_until_it_is_finished(server, tiny_run, running):
    """The run has saved its last checkpoint; its results appear while the server waits."""
    waits = []

    def wait(seconds: float) -> None:
        waits.append(server.state)
        if len(waits) == 2:
            shutil.copytree(tiny_run, running, dirs_exist_ok=True)

    live = LiveRun(running, ShownContent())
    follow(live, server, WholeMap, wait)
    first, second = waits
    assert live.finished and first == second and first.version and not first.finished
    last = server.state
    assert last.version > first.version and last.finished and last.message == "The run is finished."


def test_states_of_a_run_follow_each_other(server, caplog):
    caplog.set_level("INFO")
    scene = two_panels(40)
    later = replace(scene, title="later")
    broken = RunFolderError("half of it")
    run = Steps(server, None, scene, None, broken, broken, later, later)
    run.followed()
    versions, messages, finished = zip(*run.seen, strict=True)
    assert versions[0] == 0 < versions[1] == versions[4] < versions[5]
    assert messages[:3] == ("Waiting for the first frames of the run.", "", "")
    assert messages[3:] == ("The run cannot be read at the moment: half of it",) * 2 + ("",)
    assert not any(finished) and server.state.finished
    assert sum("half of it" in text for text in caplog.messages) == 1, "an error is logged once"


def test_a_run_that_cannot_be_read_at_first_is_an_error(server):
    with pytest.raises(RunFolderError, match="half"):
        Steps(server, None, RunFolderError("half of it"), two_panels()).followed()


def test_a_server_leaves_most_of_the_time_to_the_run(server):
    run = Steps(server, *[two_panels(40)] * 2, takes_s=0.6)
    run.followed()
    assert run.waits_s[0] > 2.0 * 0.6
    quick = Steps(server, *[two_panels(40)] * 2)
    quick.followed()
    assert quick.waits_s == [1.0]
