"""How `benchmarks.trainers` runs another trainer and scores its maps; the trainer is a stand-in."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import trainer_runs, trainer_scores, trainers
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.io.splats import Splats, write_splat_ply
from toolkit.runs.evaluation.run_metrics import TrackedFrame
from toolkit.runs.maps.splat_clouds import read_cloud

CAMERA = Camera(40.0, 40.0, 16.0, 11.0, 32, 24)
T_MAP_CAMERA = se3.exp(np.array([0.3, -0.2, 0.1, 0.1, 0.2, -0.3]))


def stand_in(folder: Path, script: str) -> trainer_runs.OpenSplat:
    program = folder / "opensplat"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    return trainer_runs.OpenSplat(program)


def frame(index: int = 0) -> Frame:
    rgb = np.random.default_rng(index).uniform(0.0, 1.0, (24, 32, 3)).astype(np.float32)
    depth_m = np.full((24, 32), 2.0, np.float32)
    depth_m[:, :16] = 0.0
    return Frame(index, float(index), rgb, depth_m, CAMERA)


def test_the_program_is_found_by_option_or_variable(tmp_path):
    program = tmp_path / "opensplat"
    with pytest.raises(SystemExit, match="variable OPENSPLAT"):
        trainers.program_path(None, {})
    with pytest.raises(SystemExit, match="is not a program"):
        trainers.program_path(program, {})
    program.write_text("")
    program.chmod(0o755)
    assert trainers.program_path(program, {}) == program
    assert trainers.program_path(None, {trainers.VARIABLE: str(program)}) == program
    with pytest.raises(SystemExit, match="is not a program"):
        trainers.program_path(tmp_path, {})


def test_training_gets_the_steps_and_keeps_the_frame_of_the_poses(tmp_path):
    trainer = stand_in(tmp_path, 'echo "$@" > "$3"; echo "$OMP_NUM_THREADS" >> "$3"')
    out = tmp_path / "map.ply"
    assert trainer.train(tmp_path / "project", out, 40, save_every=20) >= 0.0
    words = out.read_text().split()
    assert words[:5] == [str(tmp_path / "project"), "-o", str(out), "-n", "40"]
    assert "--keep-crs" in words and "--cpu" in words and words[-1] == "1"
    assert words[words.index("--save-every") + 1] == "20"


@pytest.mark.parametrize(
    ("script", "message"),
    [("echo no points >&2; exit 3", "exit status 3\nno points"), ("exit 0", "did not write")],
)
def test_a_failed_training_is_reported(script: str, message: str, tmp_path):
    with pytest.raises(SystemExit, match=message):
        stand_in(tmp_path, script).train(tmp_path, tmp_path / "map.ply", 1)


def test_a_program_that_cannot_be_started_is_reported(tmp_path):
    with pytest.raises(SystemExit, match="cannot be started"):
        trainer_runs.cpu_seconds([str(tmp_path / "missing")])


def test_cpu_seconds_count_work_and_not_waiting():
    loop = "i=0; while [ $i -lt 60000 ]; do i=$((i+1)); done"
    assert trainer_runs.cpu_seconds(["sh", "-c", loop]) > 0.01
    assert trainer_runs.cpu_seconds(["sleep", "0.1"]) < 0.05


def test_the_steps_of_a_budget_follow_from_short_runs(monkeypatch, tmp_path):
    runs = []

    def train(_, project: Path, out: Path, steps: int, save_every: int | None = None) -> float:
        runs.append(steps)
        return 1.5 + 0.25 * steps

    monkeypatch.setattr(trainer_runs.OpenSplat, "train", train)
    trainer = trainer_runs.OpenSplat(tmp_path)
    assert trainer.steps(tmp_path, tmp_path / "trial.ply", 11.5) == 40
    assert trainer.steps(tmp_path, tmp_path / "trial.ply", 0.1) == 1
    assert len(runs) == 2
    with pytest.raises(SystemExit, match="no measurable time"):
        trainer_runs.steps_within(10.0, 1.0, 0.0)


def test_the_project_holds_keyframes_and_no_held_out_frame(tmp_path):
    frames = {index: frame(index) for index in range(4)}
    run = SimpleNamespace(
        keyframes=[0, 2, 3],
        tracked=[TrackedFrame(i, float(i), T_MAP_CAMERA, held_out=i == 3) for i in frames],
        camera=CAMERA,
        open_dataset=lambda: frames,
    )
    folder = trainer_runs.trainer_input(run, tmp_path / "project", 100, 0)
    content = json.loads((folder / "transforms.json").read_text())
    names = [image["file_path"] for image in content["frames"]]
    assert names == ["images/frame_000000.png", "images/frame_000002.png"]
    assert all((folder / name).is_file() for name in names)
    assert b"element vertex 100\n" in (folder / content["ply_file_path"]).read_bytes()


def test_points_lie_on_the_measured_surface():
    view = frame()
    points = trainer_runs.sampled(view, T_MAP_CAMERA, 50, np.random.default_rng(0))
    seen = se3.transform_points(se3.inverse(T_MAP_CAMERA), points.points_m)
    columns, rows = CAMERA.project(seen).round().astype(int).T
    np.testing.assert_allclose(seen[:, 2], 2.0)
    assert len(points) == 50 and columns.min() >= 16
    np.testing.assert_array_equal(points.rgb, (255 * view.rgb[rows, columns]).round())


def test_a_near_view_is_closer_to_the_surface():
    near = trainer_scores.approached(T_MAP_CAMERA, frame().depth_m)
    np.testing.assert_allclose((se3.inverse(T_MAP_CAMERA) @ near)[:3, 3], [0.0, 0.0, 1.2])
    empty = trainer_scores.approached(T_MAP_CAMERA, np.zeros((24, 32), np.float32))
    np.testing.assert_allclose(empty, T_MAP_CAMERA)


def test_both_maps_are_scored_on_held_out_frames_by_one_code(tmp_path):
    path = tmp_path / "map.ply"
    means = np.array([[0.0, 0.0, 1.0]], np.float32)
    grey = np.full((1, 3), 0.5, np.float32)
    one = np.ones(1, np.float32)
    write_splat_ply(path, Splats(means, 2.0 * one, 8.0 * one, grey))
    images = {
        i: Frame(
            i, 0.0, np.full((24, 32, 3), v, np.float32), np.zeros((24, 32), np.float32), CAMERA
        )
        for i, v in enumerate((0.9, 0.25))
    }
    run = SimpleNamespace(
        tracked=[TrackedFrame(i, 0.0, np.eye(4), held_out=i == 1) for i in images],
        open_dataset=lambda: images,
    )
    plain, fitted = (
        trainer_scores.scores(run, path, trainer_scores.Look(CAMERA), fit) for fit in (False, True)
    )
    assert plain["unseen psnr db"] == pytest.approx(-20.0 * np.log10(0.25), abs=0.2)
    assert fitted["unseen psnr db"] > 40.0
    assert plain["gaussians"] == 1 and plain["mb"] == path.stat().st_size / 1e6


def test_the_trainers_maps_are_seen_as_while_they_are_trained(tmp_path):
    look = trainer_scores.trained_look(CAMERA)
    assert (look.camera.cx, look.camera.cy, look.camera.fx) == (15.5, 11.5, CAMERA.fx)
    path = tmp_path / "map.ply"
    behind = np.array([[0.0, 0.0, -1.0]], np.float32)
    one = np.ones(1, np.float32)
    write_splat_ply(path, Splats(behind, one, one, np.ones((1, 3), np.float32)))
    empty = trainer_scores.rendered_view(read_cloud(path), look, np.eye(4))
    np.testing.assert_allclose(empty[0, 0], look.background, rtol=1e-6)


def test_each_map_of_a_recording_is_a_row():
    maps = {method: {trainers.UNSEEN: 30.0 + i} for i, method in enumerate(trainers.METHODS)}
    name = next(iter(trainers.CASES))
    rows = trainers.rows_of({name: [maps]})
    assert list(rows) == [f"{name}, {method}" for method in trainers.METHODS]
    (equal, long, *_) = trainers.targets(rows)
    assert (equal.value, long.value) == (-2.0, -3.0) and long.met is False
