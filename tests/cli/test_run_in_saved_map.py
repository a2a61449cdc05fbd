"""run --map: the camera is found in a finished run's map, and the outputs are of both."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from room_runs import walk
from test_register import other_tree, without_descriptors, without_submaps

from toolkit.base.geometry import se3
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.io.covariances import read_covariances
from toolkit.io.splats import read_splats
from toolkit.io.trajectories import read_tum
from toolkit.runs import session as program
from toolkit.runs.maps.finished import load_run
from toolkit.slam.loops import relocalisation
from toolkit.slam.loops.log import read_loop_log
from toolkit.tools.cli.main import main


def error_of(capsys, words: list[str]) -> str:
    assert main(words) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert line.startswith("semsplat: error: ")
    return line


@pytest.fixture(scope="module")
def T_a_camera(room_runs) -> np.ndarray:
    """[9, 4, 4] true poses of the second walk in the world of the first."""
    truth = tiny_room(14, 96, 72)[1].T_world_camera
    return room_runs.T_a_b @ se3.inverse(truth[13]) @ truth[13:4:-1]


def test_the_path_is_in_the_world_of_the_saved_map(extended, T_a_camera):
    run = load_run(extended)
    assert not run.lost and [f.index for f in run.tracked] == list(range(9))
    for frame in run.tracked:
        difference = se3.inverse(T_a_camera[frame.index]) @ frame.T_map_camera
        assert np.linalg.norm(difference[:3, 3]) < 0.03


def test_another_camera_is_found_in_the_saved_map(room_runs, tmp_path, T_a_camera):
    """Smaller images of another shape: five sixths of the focal length, cut on two sides."""
    out = tmp_path / "run"
    words = walk(room_runs.recordings[1], out, "--map", str(room_runs.a), "--max-frames", "3")
    assert main([*words, "--image-size", "72", "60"]) == 0
    run = load_run(out)
    assert not run.lost and len(run.tracked) == 3
    cameras = {k.camera.size for submap in run.submaps.values() for k in submap.keyframes}
    assert cameras == {(96, 72), (72, 60)}
    for frame in run.tracked:
        difference = se3.inverse(T_a_camera[frame.index]) @ frame.T_map_camera
        assert np.linalg.norm(difference[:3, 3]) < 0.03


def test_the_map_is_the_whole(extended, room_runs):
    splats, before = (read_splats(run / "map.ply") for run in (extended, room_runs.a))
    assert set(splats.extra["submap"].tolist()) == {0, 1}
    assert len(splats.means) > len(before.means)
    assert (splats.labels.label > 0).mean() > 0.95
    run = load_run(extended)
    assert list(run.submaps) == [0, 1] and np.array_equal(run.anchors[0], np.eye(4))
    old, new = (run.submaps[n].keyframes for n in (0, 1))
    assert max(k.index for k in old) < 0 <= min(k.index for k in new)
    assert min(run.keyframes) == 0


def test_other_programs_take_it(extended, tmp_path, capsys):
    assert main(["explain-loops", str(extended), "--refused"]) == 0
    printed = capsys.readouterr().out
    assert "submap 1 started at a frame relocalised in submap 0" in printed
    assert main(["evaluate", str(extended), "--max-views", "1", "--truth-error-m", "0.02"]) == 0
    printed = capsys.readouterr().out
    assert printed.index("loops.edges.right") < printed.index("loops.verified.overlap.precision")
    # The edge to the loaded map has no ground truth in this dataset.
    metrics = json.loads((extended / "metrics.json").read_text())
    edges = metrics["loops"]["edges"]
    assert edges["count"] == 0 and "2 cm" in edges["convention"]
    assert main(["query", str(extended), "--list"]) == 0


def test_the_pose_of_a_relocalised_frame_is_recorded(extended, room_runs):
    found = [r for r in read_loop_log(extended / "loops.jsonl") if r["kind"] == "found"]
    assert len(found) == 1 and found[0]["query"] == 0 and found[0]["match"] < 0
    run = load_run(extended)
    keyframe = next(k for k in run.submaps[0].keyframes if k.index == found[0]["match"])
    T = keyframe.T_map_camera @ np.reshape(found[0]["T_match_query"], (4, 4))
    np.testing.assert_allclose(T, run.tracked[0].T_map_camera, atol=0.03)


def stopped_after(frames: int, monkeypatch) -> None:
    """Let a run end itself after so many frames, as if it had been killed."""
    held = program.held_out

    def counted(index: int, settings: object) -> bool:
        if index == frames:
            raise KeyboardInterrupt
        return held(index, settings)

    monkeypatch.setattr(program, "held_out", counted)


@pytest.mark.parametrize("frames", [0, 4])
def test_it_resumes_to_the_same_without_the_saved_run(
    extended, room_runs, tmp_path, monkeypatch, frames
):
    saved, out = shutil.copytree(room_runs.a, tmp_path / "saved"), tmp_path / "run"
    words = walk(room_runs.recordings[1], out, "--map", str(saved))
    words += ["--checkpoint.every-keyframes", "1"]
    with monkeypatch.context() as patch:
        stopped_after(frames, patch)
        assert main(words) == 130
    shutil.rmtree(saved)
    assert main([*words, "--resume"]) == 0
    for name in ("trajectory.txt", "map.ply", "loops.jsonl"):
        assert (out / name).read_bytes() == (extended / name).read_bytes(), name


def test_every_pose_says_how_sure_it_is(extended):
    times, covariances = read_covariances(extended / "covariances.txt")
    trajectory = read_tum(extended / "trajectory.txt")
    np.testing.assert_allclose(times, trajectory.timestamps_s, atol=1e-6)
    assert np.linalg.eigvalsh(covariances).min() > 0


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (without_submaps, "run again"),
        (without_descriptors, "--depth none or --poses given"),
        (other_tree, "semantics.taxonomy"),
    ],
)
def test_maps_that_cannot_be_extended(room_runs, tmp_path, capsys, damage, said):
    saved = shutil.copytree(room_runs.a, tmp_path / "saved")
    damage(saved)
    words = walk(room_runs.recordings[1], tmp_path / "run", "--map", str(saved))
    line = error_of(capsys, words)
    assert said in line and str(saved) in line
    assert not (tmp_path / "run").exists(), "so that the same --out can be given again"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--map", "A/nothing"], "no run"),
        (["--map", "A", "--poses", "given"], "poses 'slam'"),
        (["--map", "A", "--loops.no-use"], "loops.use"),
        (["--map", "A", "--loops.features.source", "both"], "loops.features"),
        (["--map", "A", "--semantics.code.kind", "flat"], "semantics.code"),
        (["--map", "A", "--semantics.code.kind", "none"], "labels"),
    ],
)
def test_bad_input(room_runs, tmp_path, capsys, words, said):
    words = [str(room_runs.a) + word[1:] if word[0] == "A" else word for word in words]
    line = error_of(capsys, walk(room_runs.recordings[1], tmp_path / "run", *words))
    assert said in line
    assert not (tmp_path / "run").exists()


def test_a_camera_that_is_nowhere_maps_on_its_own(room_runs, tmp_path, monkeypatch):
    """Patience is shorter than the walk, and nothing may count as found."""
    monkeypatch.setattr(relocalisation, "_MIN_VISIBLE", 1.0)
    more = ["--loops.relocalisation.patience", "2"]
    words = walk(room_runs.recordings[1], tmp_path / "run", "--map", str(room_runs.a), *more)
    assert main([*words, "--loops.closing.no-between"]) == 0
    frames = json.loads((tmp_path / "run/frames.json").read_text())
    assert frames["lost"] == [0, 1] and len(frames["submaps"]) == 2
