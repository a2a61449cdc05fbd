"""`semsplat live`: run folders of cameras that end, fail, are interrupted, or do not exist."""

from __future__ import annotations

import csv
import json
import os
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser_pages import WatchedPage, chromium
from programs import MAIN, semsplat, start
from scripted_camera import ScriptedCamera, room_frames

from toolkit.base.errors import CameraError, DatasetError, RunFolderError
from toolkit.datasets.registry import open_dataset
from toolkit.io.images import write_depth_png
from toolkit.runs import snapshots
from toolkit.runs.live import frame_writer
from toolkit.runs.live.execution import LiveHooks, run_live
from toolkit.runs.live.options import LiveOptions
from toolkit.runs.maps.finished import load_run
from toolkit.runs.settings import RunSettings
from toolkit.runs.stopping import StopSignals
from toolkit.scene.growing.options import GrowingSceneOptions
from toolkit.slam.mapping.options import KeyframePolicy, MapperOptions
from toolkit.tools.cli.live import stopped_by_signals
from toolkit.tools.cli.main import main
from toolkit.tools.viewer.html import write_page
from toolkit.tools.viewer.live import LiveRun
from toolkit.tools.viewer.options import ShownContent
from toolkit.tools.viewer.scene import ViewerScene

QUICK = MapperOptions(
    first_iterations=4, iterations=1, final_iterations=1, keyframes=KeyframePolicy(interval=1)
)
SETTINGS = RunSettings(mapping=QUICK)
FRAMES = room_frames(4)


class Follower:
    """An observer that lets the camera show its next frame when one was processed."""

    def __init__(self, taken=None) -> None:
        self.calls: list[str] = []
        self._taken = taken

    def started(self, run) -> None:
        self.calls.append(f"started {run.name}")

    def frame_processed(self, frame, result) -> None:
        self.calls.append(f"frame {frame.index}")
        if self._taken is not None:
            self._taken.release()

    def finished(self, result) -> None:
        self.calls.append("finished")

    def close(self) -> None:
        self.calls.append("close")


def read_json(path: Path):
    return json.loads(path.read_text(encoding="utf-8"))


def replay(recording: Path, *words: str) -> list[str]:
    place = ["--dataset.kind", "folder", "--dataset.path", str(recording)]
    quick = ["--mapping.first-iterations", "4", "--mapping.final-iterations", "1"]
    return ["--camera", "replay", *place, *quick, *words]


def one_by_one(error: Exception | None = None) -> tuple[ScriptedCamera, Follower]:
    """A camera that waits for each frame to be processed, and what it waits for."""
    taken = threading.Semaphore(0)
    return ScriptedCamera(FRAMES, error, taken=taken), Follower(taken)


def test_frames_of_a_camera_make_a_map_and_can_be_run_again(tmp_path: Path):
    camera, follower = one_by_one()
    out = tmp_path / "run"
    hooks = LiveHooks(observers=[follower])
    run_live(SETTINGS, LiveOptions(save_frames=True), camera, out, hooks)
    frames = [f"frame {i}" for i in range(4)]
    assert follower.calls == ["started scripted", *frames, "finished", "close"]
    metrics = read_json(out / "metrics.json")
    assert metrics["live"]["camera"] == "scripted"
    assert (metrics["live"]["frames_captured"], metrics["live"]["frames_dropped"]) == (4, 0)
    live = metrics["live"]
    assert live["delay_max_ms"] >= live["delay_p95_ms"] >= live["delay_median_ms"] > 0
    assert (out / "report.html").is_file() and (out / "map.ply").is_file()
    # The run folder names the saved frames as its dataset.
    assert main(["evaluate", str(out)]) == 0
    again = tmp_path / "again"
    assert main(["run", "--config", str(out / "config.yaml"), "--out", str(again)]) == 0
    assert len(load_run(again).tracked) == 4
    live, offline = load_run(out), load_run(again)
    assert live.trajectory.timestamps_s.tolist() == offline.trajectory.timestamps_s.tolist()


class Viewer(Follower):
    """Follows the run like a viewer, and releases the camera when it has seen the newest frame."""

    def __init__(self, taken) -> None:
        super().__init__(taken)
        self.scenes: list[ViewerScene] = []

    def started(self, run) -> None:
        self.live = LiveRun(run.folder.path, ShownContent())
        assert self.live.poll() is None

    def frame_processed(self, frame, result) -> None:
        deadline_s = time.monotonic() + 30.0
        while (scene := self.live.poll()) is None:
            assert time.monotonic() < deadline_s
            time.sleep(0.01)
        self.calls.append(f"{scene.title}: {len(scene.keyframes)} keyframes")
        self.scenes.append(scene)
        super().frame_processed(frame, result)


def test_a_viewer_follows_a_live_run(tmp_path: Path, monkeypatch):
    for name in ("_EVERY_S", "_LOOK_EVERY_S"):
        monkeypatch.setattr(snapshots, name, 0.0)
    monkeypatch.setattr(snapshots, "_MAX_SHARE", 1e9)
    taken = threading.Semaphore(0)
    viewer, out = Viewer(taken), tmp_path / "run"
    camera = ScriptedCamera(FRAMES, taken=taken)
    settings = replace(SETTINGS, scene=GrowingSceneOptions(graph=True))
    run_live(settings, LiveOptions(), camera, out, LiveHooks(observers=[viewer]))
    shown = [call for call in viewer.calls if "keyframes" in call]
    assert shown == [f"run, frame {i + 1}: {i + 1} keyframes" for i in range(4)]
    growing = viewer.scenes[-1]
    assert not viewer.scenes[0].objects and growing.objects, "objects appear while the map grows"
    final = viewer.live.poll()
    assert final.title == "run" and viewer.live.finished
    assert names(growing).items() & names(final).items(), "the finished run has the same objects"
    assert not (out / "live").exists()
    assert all(one.voxels_m is not None for one in growing.objects)
    with chromium() as browser:
        page = WatchedPage(browser, evaluate=True)
        for scene in (growing, final):
            overhang_m = overhang_at_clicks(page, scene, tmp_path / "page.html")
            assert len(overhang_m) > 20 and np.percentile(overhang_m, 90) < 0.1


def names(scene: ViewerScene) -> dict[int, str]:
    return {one.number: one.name for one in scene.objects}


CHOOSE = """([rows, eye, focal, pixels]) => {
  const { scene } = semsplatViewer;
  return pixels.map(([x, y]) => {
    const splat = pickSplat(scene, { view: { rows, eye }, focal, width: 0, height: 0 }, x, y);
    return splat === null ? null : objectOf(scene, describeSplat(scene, splat))?.number ?? null;
  });
}"""


def overhang_at_clicks(page: WatchedPage, scene: ViewerScene, file: Path) -> list[float]:
    """How far the surface lies outside of the box of the chosen object, at pixels that choose one.

    The pixels are those of the last frame, the surface is its true depth.
    """
    write_page(file, scene)
    page.page.goto(file.as_uri())
    frame, T = FRAMES[-1], scene.path[-1]
    points_m = frame.camera.unproject(frame.depth_m, 4).reshape(-1, 3)
    pixels = frame.camera.fx * points_m[:, :2] / points_m[:, 2:]
    view = [T[:3, :3].T.tolist(), T[:3, 3].tolist(), frame.camera.fx, pixels.tolist()]
    corners_m = {one.number: one.corners_m for one in scene.objects}
    found_m = []
    for point_m, number in zip(points_m, page.page.evaluate(CHOOSE, view), strict=True):
        if number is not None:
            box_m = corners_m[number]
            edges_m = box_m[[1, 2, 4]] - box_m[0]
            sizes_m = np.linalg.norm(edges_m, axis=1)
            offset_m = T[:3, :3] @ point_m + T[:3, 3] - box_m.mean(axis=0)
            along_m = edges_m / sizes_m[:, None] @ offset_m
            found_m.append(float((np.abs(along_m) - sizes_m / 2).max()))
    return found_m


def test_frames_of_a_camera_are_removed_unless_they_are_wanted(tmp_path: Path):
    camera, follower = one_by_one()
    run_live(SETTINGS, LiveOptions(), camera, tmp_path / "run", LiveHooks(observers=[follower]))
    assert not (tmp_path / "run" / "recording").exists()
    assert read_json(tmp_path / "run" / "metrics.json")["images"]["mapped"]["psnr_db"] > 10


def test_a_camera_that_is_unplugged_leaves_a_finished_map_and_an_error(tmp_path: Path):
    camera, follower = one_by_one(CameraError("scripted failed: unplugged"))
    out = tmp_path / "run"
    with pytest.raises(CameraError, match="unplugged; the map so far was saved in"):
        run_live(SETTINGS, LiveOptions(), camera, out, LiveHooks(observers=[follower]))
    assert len(load_run(out).tracked) == 4
    assert camera.stopped.is_set()
    assert "The recording ended early" in (out / "log.txt").read_text(encoding="utf-8")


def test_a_full_disk_is_one_error_and_keeps_the_frames_before(tmp_path: Path, monkeypatch):
    def fails_later(path: Path, depth_m, scale: float) -> None:
        if path.stem == "000002":
            raise RunFolderError(f"cannot write {path}: no space left on device")
        write_depth_png(path, depth_m, scale)

    monkeypatch.setattr(frame_writer, "write_depth_png", fails_later)
    camera, follower = one_by_one()
    hooks = LiveHooks(observers=[follower])
    with pytest.raises(RunFolderError, match="no space left"):
        run_live(SETTINGS, LiveOptions(), camera, tmp_path / "run", hooks)
    assert follower.calls[-1] == "close"
    assert len(open_dataset("folder", tmp_path / "run" / "recording")) >= 2


def test_without_a_usable_frame_nothing_is_left_behind(tmp_path: Path):
    blind = [replace(f, depth_m=0 * f.depth_m) for f in FRAMES[:1]]
    with pytest.raises(DatasetError, match="could start a map"):
        run_live(SETTINGS, LiveOptions(), ScriptedCamera(blind), tmp_path / "run", LiveHooks())
    camera = ScriptedCamera(blind, CameraError("unplugged"))
    with pytest.raises(CameraError, match="unplugged"):
        run_live(SETTINGS, LiveOptions(), camera, tmp_path / "run", LiveHooks())
    assert not (tmp_path / "run").exists()


def test_dropped_frames_of_a_replay_are_counted_and_scored(tiny_recording: Path, tmp_path: Path):
    out = tmp_path / "run"
    words = replay(tiny_recording, "--fps", "1000", "--out", str(out))
    assert main(["live", *words]) == 0
    metrics, frames = read_json(out / "metrics.json"), read_json(out / "frames.json")
    assert metrics["live"]["frames_dropped"] == len(frames["dropped"]) > 0
    assert metrics["frames"]["total"] == metrics["live"]["frames_captured"] == 6
    assert metrics["trajectory"]["ate_pairs"] == 6
    run = load_run(out)
    assert [frame.index for frame in run.tracked] == list(range(6))
    first = frames["dropped"][0]
    before, dropped = run.tracked[first - 1], run.tracked[first]
    assert dropped.T_map_camera.tolist() == before.T_map_camera.tolist()
    with (out / "delays.csv").open(encoding="utf-8") as file:
        outcomes = [row["outcome"] for row in csv.DictReader(file)]
    assert [i for i, outcome in enumerate(outcomes) if outcome == "dropped"] == frames["dropped"]
    assert "Delay over time" in (out / "report.html").read_text(encoding="utf-8")


def test_a_paced_replay_has_the_metrics_of_both(tiny_recording: Path, tmp_path: Path):
    out = tmp_path / "run"
    assert main(["live", *replay(tiny_recording, "--pace", "50", "--out", str(out))]) == 0
    metrics = read_json(out / "metrics.json")
    assert metrics["pace"]["fps"] == 50
    assert metrics["live"]["frames_captured"] == 6
    assert metrics["pace"]["mapping_steps_due"] >= metrics["pace"]["mapping_steps_skipped"]
    assert metrics["live"]["frames_dropped"] == len(read_json(out / "frames.json")["dropped"])


def test_ctrl_c_finishes_the_map(tiny_recording: Path, tmp_path: Path):
    out = tmp_path / "run"
    # The second frame would come after a hundred seconds.
    slow = ["--fps", "0.01", "--checkpoint.every-keyframes", "1"]
    words = replay(tiny_recording, *slow, "--out", str(out))
    program = start("-m", MAIN, "live", *words)
    deadline_s = time.monotonic() + 60.0
    checkpoint = out / "checkpoint" / "0" / "metadata.json"
    while not checkpoint.exists():  # it is saved after the first frame
        assert program.poll() is None and time.monotonic() < deadline_s
        time.sleep(0.05)
    os.kill(program.pid, signal.SIGINT)
    _, errors = program.communicate(timeout=60.0)
    assert program.returncode == 0, errors
    assert "press Ctrl-C again" in errors
    assert len(load_run(out).tracked) == 1
    assert read_json(out / "metrics.json")["frames"]["total"] == 1


def test_the_second_ctrl_c_interrupts():
    stop = threading.Event()
    before = signal.getsignal(signal.SIGINT)

    def press_twice() -> None:
        signal.raise_signal(signal.SIGINT)
        assert stop.is_set()
        signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt), stopped_by_signals(stop, StopSignals()):
        press_twice()
    assert signal.getsignal(signal.SIGINT) is before


def test_a_recording_that_breaks_off_is_a_camera_that_fails(
    tiny_recording: Path, tmp_path: Path, capsys
):
    recording, out = tmp_path / "broken", tmp_path / "run"
    for source in sorted(tiny_recording.rglob("*")):
        target = recording / source.relative_to(tiny_recording)
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_file():
            target.write_bytes(source.read_bytes())
    (recording / "rgb" / "0003.png").write_bytes(b"")
    assert main(["live", *replay(recording, "--fps", "20", "--out", str(out))]) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("semsplat: error:") and "0003.png" in last and str(out) in last
    assert (out / "map.ply").is_file() and (out / "report.html").is_file()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--camera", "replay"], "--camera replay needs a dataset"),
        (["--camera", "kinect"], "kinect"),
        (["--camera", "replay", "--dataset.path", "nowhere"], "nowhere"),
        (["--camera", "replay", "--fps", "0"], "fps"),
        (["--camera", "replay", "--depth", "none", "--dataset.path", "x"], "remove --depth none"),
        (["--camera", "replay", "--poses", "given"], "needs a dataset"),
    ],
)
def test_bad_arguments_are_one_line(words: list[str], message: str, tmp_path: Path, capsys):
    assert main(["live", *words, "--out", str(tmp_path / "run")]) == 2
    errors = capsys.readouterr().err.strip().splitlines()
    assert message in errors[-1]
    assert not (tmp_path / "run").exists()


def test_bad_input_is_one_line_and_leaves_other_files_alone(tmp_path: Path):
    other = tmp_path / "run" / "notes.txt"
    other.parent.mkdir()
    other.write_text("mine")
    words = ("--camera", "replay", "--dataset.path", "nowhere", "--out", other.parent)
    done = semsplat("live", *words)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1 and "nowhere" in done.stderr
    assert other.read_text() == "mine"
