"""`semsplat run --depth none`: maps from colour alone."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from moving_camera import film, turn, walk, wind
from test_finished_run_programs import one_line_of_error

from toolkit.base.geometry.trajectory import Trajectory
from toolkit.io import images
from toolkit.io.length_names import LengthNames
from toolkit.io.splats import read_splats
from toolkit.io.trajectories import read_tum, write_tum
from toolkit.tools.cli.main import main

QUICK = [
    *("--mapping.first-iterations", "6"),
    *("--mapping.iterations", "3"),
    *("--mapping.final-iterations", "2"),
    *("--mapping.keyframes.interval", "1"),
]


def write_film(folder: Path, poses: np.ndarray) -> Path:
    """A recording of kind `folder` without depth."""
    frames = film(poses)
    (folder / "rgb").mkdir(parents=True)
    for frame in frames:
        images.write_rgb(folder / "rgb" / f"{frame.index:03d}.png", frame.rgb)
    camera = frames[0].camera
    names = ("fx", "fy", "cx", "cy", "width", "height")
    intrinsics = {name: getattr(camera, name) for name in names} | {"fps": 30.0}
    (folder / "intrinsics.yaml").write_text(yaml.safe_dump(intrinsics))
    write_tum(folder / "trajectory.txt", Trajectory(np.arange(len(poses)) / 30.0, poses))
    return folder


def arguments(recording: Path, out: Path, *more: str) -> list[str]:
    place = ["--dataset.kind", "folder", "--dataset.path", str(recording)]
    return ["run", *place, *QUICK, "--out", str(out), *more]


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    return write_film(tmp_path_factory.mktemp("film") / "walk", walk(12))


@pytest.fixture(scope="module")
def run(recording, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "run"
    assert main(arguments(recording, out, "--depth", "none")) == 0
    return out


def metrics_of(run: Path) -> dict:
    return json.loads((run / "metrics.json").read_text())


def psnr_db(metrics: dict) -> float:
    return metrics["images"]["mapped"]["psnr_db"]


def test_colour_alone_gives_a_trajectory_and_a_map(run):
    metrics = metrics_of(run)
    assert metrics["trajectory"]["alignment"] == "sim3"
    assert metrics["trajectory"]["ate_rmse_cm"] < 3.0  # of 52 cm
    assert metrics["trajectory"]["scale"] != 1.0
    assert metrics["monocular"]["reliable"] is True
    assert metrics["images"]["mapped"]["psnr_db"] > 20.0
    assert len(read_tum(run / "trajectory.txt")) == 12
    assert len(read_splats(run / "map.ply").means) > 1000


def test_a_run_can_be_evaluated_again(run, capsys):
    before = metrics_of(run)
    assert main(["evaluate", str(run)]) == 0
    after = metrics_of(run)
    ate_rmse_cm = before["trajectory"]["ate_rmse_cm"]
    assert after["trajectory"]["ate_rmse_cm"] == pytest.approx(ate_rmse_cm, rel=1e-3)
    assert psnr_db(after) == pytest.approx(psnr_db(before), abs=0.05)
    assert after["monocular"]["reliable"] is True


def test_an_estimated_focal_length_is_used_again(tmp_path):
    frames = film(wind())
    path, out = tmp_path / "film.avi", tmp_path / "run"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, (160, 120))
    for frame in frames:
        writer.write(np.round(255 * frame.rgb[..., ::-1]).astype(np.uint8))
    writer.release()
    place = ["--dataset.kind", "video", "--dataset.path", str(path), "--depth", "none"]
    assert main(["run", *place, *QUICK, "--out", str(out)]) == 0
    before = metrics_of(out)
    assert before["monocular"]["focal_px"] == pytest.approx(frames[0].camera.fx, rel=0.05)
    assert main(["evaluate", str(out)]) == 0
    assert psnr_db(metrics_of(out)) == pytest.approx(psnr_db(before), abs=0.05)


def test_a_known_distance_gives_a_map_in_metres(recording, tmp_path):
    truth = read_tum(recording / "trajectory.txt").positions_m
    distance_m = str(np.linalg.norm(truth[11] - truth[0]))
    known = ["--scale.distance-m", distance_m, "--scale.distance-frames", "0", "11"]
    assert main(arguments(recording, tmp_path / "run", "--depth", "none", *known)) == 0
    metrics = metrics_of(tmp_path / "run")
    assert metrics["trajectory"]["scale"] == pytest.approx(1.0, abs=0.05)
    assert metrics["monocular"]["metric_scale"] > 0
    assert metrics["monocular"]["metric_scale_sigma_percent"] < 5
    found = read_tum(tmp_path / "run/trajectory.txt").positions_m
    assert np.linalg.norm(found[11] - found[0]) == pytest.approx(float(distance_m), rel=0.05)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--scale.camera-height-m", "1.5"), "add --depth none"),
        (("--depth", "none", "--scale.distance-m", "1"), "belong together"),
        (
            ("--depth", "none", "--scale.distance-m", "1", "--scale.distance-frames", "0", "99"),
            "frames below 12",
        ),
    ],
)
def test_lengths_that_cannot_be_used_are_refused(recording, tmp_path, capsys, words, message):
    capsys.readouterr()
    error = one_line_of_error(capsys, *arguments(recording, tmp_path / "run", *words))
    assert message in error
    assert not (tmp_path / "run").exists()


def test_runs_are_reproducible(recording, run, tmp_path):
    assert main(arguments(recording, tmp_path / "again", "--depth", "none")) == 0
    for name in ("trajectory.txt", "map.ply"):
        assert (tmp_path / "again" / name).read_bytes() == (run / name).read_bytes()


def test_a_camera_that_only_turns_ends_without_a_map(tmp_path, capsys):
    recording = write_film(tmp_path / "turn", turn(10))
    out = tmp_path / "run"
    assert main(arguments(recording, out, "--depth", "none")) == 0
    metrics = metrics_of(out)
    assert metrics["monocular"]["reliable"] is False
    assert "the camera has only turned" in metrics["monocular"]["doubts"]
    assert "The result is not reliable" in (out / "log.txt").read_text()
    assert not (out / "map.ply").exists()


def test_a_recording_without_depth_needs_the_option(recording, tmp_path, capsys):
    assert main(arguments(recording, tmp_path / "run")) == 2
    assert "--depth none" in one_line_of_error(capsys)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("words", [("--pace", "30"), ("--map", "somewhere")])
def test_what_needs_depth_is_refused(recording, tmp_path, capsys, words):
    assert main(arguments(recording, tmp_path / "run", "--depth", "none", *words)) == 2
    line = one_line_of_error(capsys)
    assert words[0] in line
    assert "needs depth images" in line


def test_without_a_known_length_no_output_is_in_metres(run, tmp_path, capsys, caplog):
    frames = json.loads((run / "frames.json").read_text())
    assert frames["metric"] is False
    report = (run / "report.html").read_text()
    assert "first camera, units" in report and "first camera, m<" not in report
    assert report.count("lengths are in arbitrary units") == 1
    assert "lengths are in arbitrary units" in (run / "log.txt").read_text()
    assert main(["export", str(run), "--to", str(tmp_path / "map.ply")]) == 0
    assert "map.ply: lengths are in arbitrary units" in caplog.text
    assert b"comment lengths are in arbitrary units" in (tmp_path / "map.ply").read_bytes()
    assert main(["export", str(run), "--to", str(tmp_path / "map.gltf")]) == 0
    tree = json.loads((tmp_path / "map.gltf").read_text())
    assert tree["nodes"][0]["extras"]["metric"] is False
    if (run / "taxonomy.yaml").exists():
        capsys.readouterr()
        assert main(["query", str(run), "object"]) == 0
        text = capsys.readouterr().out
        assert "size (units)" in text and "(m)" not in text and "(m2)" not in text


def test_names_of_lengths():
    metric, arbitrary = LengthNames(), LengthNames(metric=False)
    assert (metric.length, metric.area, metric.notes) == ("m", "m2", ())
    assert (arbitrary.length, arbitrary.area) == ("units", "square units")
    assert len(arbitrary.notes) == 1
