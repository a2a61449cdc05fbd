"""Refinement of a finished run's map in tasks."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from toolkit.base.exposure import Exposure
from toolkit.base.geometry import se3
from toolkit.io import storage
from toolkit.io.trajectories import read_tum
from toolkit.runs.batch.refining.anchors import chosen_pairs, corrected_anchors, possible_pairs
from toolkit.runs.batch.refining.pipeline import refine_map
from toolkit.runs.batch.refining.tasks import Extent, InThisProcess, PairResult
from toolkit.runs.batch.refining.trajectory import moved_frames
from toolkit.runs.maps.finished import FinishedRun, load_run
from toolkit.slam.loops.closing.options import ClosingOptions, LoopClosureOptions
from toolkit.slam.loops.registration.result import failed
from toolkit.splatting.rendering import render
from toolkit.tools.cli.main import main


@pytest.fixture(scope="module")
def refined(submaps_run: Path, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("refined") / "out"
    refine_map(str(submaps_run), str(out), InThisProcess())
    return out


def test_a_refined_run_is_a_finished_run(submaps_run, refined):
    before, after = load_run(submaps_run), load_run(refined)
    assert len(after.submaps) == len(before.submaps) > 1
    assert after.keyframes == before.keyframes
    # The registrations agree with the poses, which stay as they are.
    assert (refined / "trajectory.txt").read_bytes() == (
        submaps_run / "trajectory.txt"
    ).read_bytes()
    assert any(pair["reason"] == "" for pair in json.loads(read(refined, "refine.json"))["pairs"])
    for n in range(len(before.submaps)):
        # Ellipsoids were fitted already: spheres gained 0.4 to 1.0 dB.
        assert keyframe_psnr_db(after, n) > keyframe_psnr_db(before, n) - 0.2
    assert "scratch" not in {path.name for path in refined.iterdir()}


def keyframe_psnr_db(run: FinishedRun, number: int) -> float:
    """How well a submap shows the images of its keyframes."""
    submap = run.submaps[number]
    errors = []
    for keyframe in submap.keyframes:
        shown = render(submap.gaussians, run.camera, se3.inverse(keyframe.T_map_camera))
        image = keyframe.rgb.permute(1, 2, 0) / 255.0
        errors.append(float((shown.colour - image).square().mean()))
    return -10.0 * np.log10(np.mean(errors))


@pytest.mark.parametrize("compared", [60, 0])
@pytest.mark.parametrize("shift_m", [0.15, 0.005])
def test_only_registrations_that_contradict_the_poses_move_submaps(shift_m, compared, monkeypatch):
    # Large graphs are solved without comparing all pairs.
    monkeypatch.setattr("toolkit.runs.batch.refining.anchors._MAX_COMPARED", compared)
    true = {n: se3.exp(np.array([n, 0.0, 0.0, 0.0, 0.1 * n, 0.0])) for n in (0, 2, 5)}
    shift = se3.exp(np.array([0.0, 0.0, shift_m, 0.0, 0.0, 0.0]))
    moved = {n: T if n == 0 else shift @ T for n, T in true.items()}
    corner = np.zeros(3)
    # After five metres the odometry has drifted by several centimetres.
    extents = {n: Extent(corner, corner, 5.0, 2.0, 9) for n in true}
    accepted = failed("fine", "")
    results = [
        PairResult(
            a,
            b,
            replace(
                accepted,
                T_target_source=se3.inverse(true[a]) @ true[b],
                information=1e8 * np.eye(6),
            ),
            reason,
        )
        for a, b, reason in ((0, 2, ""), (0, 5, ""), (2, 5, ""))
    ]
    wrong = replace(accepted, T_target_source=shift @ shift, information=1e8 * np.eye(6))
    results.append(PairResult(0, 5, wrong, "too little overlap"))
    after = corrected_anchors(moved, extents, results, LoopClosureOptions())
    errors = [np.abs(after.T_world_submap[n] - true[n]).max() for n in true]
    if shift_m > 0.1:
        assert max(errors) < 0.2 * shift_m and after.largest_m == pytest.approx(shift_m, rel=0.2)
        assert after.used == {(0, 2), (0, 5), (2, 5)}
    else:
        assert after.largest_m == 0.0
        assert all(np.array_equal(after.T_world_submap[n], moved[n]) for n in true)


def test_frames_move_with_their_submap(submaps_run):
    frames = json.loads(read(submaps_run, "frames.json"))
    T_old = {row["number"]: np.array(row["T_world_submap"]) for row in frames["submaps"]}
    shift = se3.exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
    T_new = {n: shift @ T if n == 2 else T for n, T in T_old.items()}
    text = (submaps_run / "trajectory.txt").read_bytes()
    text, after = moved_frames(text, frames, T_old, T_new, {})
    lines = [np.array(t.split()[1:4], float) for t in text.decode().splitlines() if t[0] != "#"]
    old = read_tum(submaps_run / "trajectory.txt").positions_m
    first, last = (frames["submaps"][n]["keyframes"][0] for n in (2, 3))
    for row, before, now in zip(frames["frames"], old, lines, strict=True):
        inside = first <= row["index"] < last
        assert now - before == pytest.approx([0.1 * inside, 0.0, 0.0], abs=1e-6)
    assert np.array_equal(after["submaps"][2]["T_world_submap"], T_new[2])


def test_shared_storage_gives_the_same_map(submaps_run, refined):
    pytest.importorskip("fsspec", reason="fsspec is not installed")
    copy_to(submaps_run, "memory://bucket/run")
    refine_map("memory://bucket/run", "memory://bucket/out", InThisProcess())
    assert_same(refined, "memory://bucket/out")


@pytest.fixture
def s3(monkeypatch):
    """The root URL of a bucket on moto's server, a process of its own.

    moto conflicts with pinned packages: `SEMSPLAT_MOTO_SERVER` names the program `moto_server` of
    another environment.
    """
    s3fs = pytest.importorskip("s3fs", reason="s3fs is not installed")
    program = os.environ.get("SEMSPLAT_MOTO_SERVER") or shutil.which("moto_server")
    if program is None:
        pytest.skip("SEMSPLAT_MOTO_SERVER is not set, and moto_server is not installed")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [program, "-H", "127.0.0.1", "-p", str(port)]
    server = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "testing")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    try:
        deadline_s = time.monotonic() + 30.0
        while not _listens(port):
            assert server.poll() is None and time.monotonic() < deadline_s, "moto did not start"
            time.sleep(0.05)
        s3fs.S3FileSystem.clear_instance_cache()
        s3fs.S3FileSystem().mkdir("maps")
        yield "s3://maps"
        s3fs.S3FileSystem.clear_instance_cache()
    finally:
        server.terminate()
        server.wait()


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def test_s3_gives_the_same_map(submaps_run, refined, s3):
    copy_to(submaps_run, f"{s3}/run")
    assert main(["refine", f"{s3}/run", "--out", f"{s3}/out"]) == 0
    assert_same(refined, f"{s3}/out")


def test_workers_read_and_write_s3(submaps_run, refined, s3):
    pytest.importorskip("ray", reason="ray is not installed (pip install 'semsplat[cluster]')")
    copy_to(submaps_run, f"{s3}/run")
    words = ["--ray.cpus", "2", "--memory-gb", "0.5"]
    assert main(["refine", f"{s3}/run", "--out", f"{s3}/out", *words]) == 0
    assert_same(refined, f"{s3}/out")


def test_missing_content_of_s3_is_one_line(s3, capsys):
    for place in (f"{s3}/nothing", "s3://no-such-bucket/run"):
        assert main(["refine", place, "--out", f"{s3}/out"]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert place in line
    assert storage.names_in(f"{s3}/out") == []


def test_runs_that_cannot_be_refined_are_refused(submaps_run, tmp_path, capsys):
    def error(run: Path, out: Path = tmp_path / "new") -> str:
        assert main(["refine", str(run), "--out", str(out)]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        return line

    capsys.readouterr()
    assert "contains no run" in error(tmp_path)
    assert "is not an empty folder" in error(submaps_run, submaps_run)
    run = shutil.copytree(submaps_run, tmp_path / "run")
    config = run / "config.yaml"
    text = config.read_text()
    config.write_text(text.replace("\nmap: null\n", "\nmap: /elsewhere\n"))
    assert "refine that run" in error(run)
    config.write_text(text)
    (run / "submaps/0001_1/arrays.npz").write_bytes(b"")
    assert "0001_1" in error(run)
    assert not (tmp_path / "new").exists()
    shutil.rmtree(run / "submaps")
    assert "submaps are missing" in error(run)
    (run / "map.ply").unlink()
    assert "not finished" in error(run)
    assert not (tmp_path / "new").exists()


def test_pairs_are_chosen_by_boxes_and_overlap():
    def at(x: float) -> Extent:
        corner = np.array([x, 0.0, 0.0])
        return Extent(corner, corner + 1.0, 1.0, 0.1, 5)

    extents = {3: at(0.0), 7: at(0.5), 8: at(1.4), 9: at(9.0)}
    assert possible_pairs(extents) == [(3, 7), (7, 8)]
    overlaps = {(3, 7): 0.9, (3, 8): 0.1, (7, 8): 0.5, (3, 9): 0.45}
    assert chosen_pairs(overlaps, ClosingOptions()) == [(3, 7), (3, 9), (7, 8)]
    assert chosen_pairs(overlaps, ClosingOptions(max_partners=1)) == [(3, 7), (3, 9), (7, 8)]
    assert chosen_pairs(overlaps, ClosingOptions(max_partners=0)) == []


def test_frames_keep_their_exposure_relative_to_their_submap(submaps_run):
    frames = json.loads(read(submaps_run, "frames.json"))
    anchors = {row["number"]: np.array(row["T_world_submap"]) for row in frames["submaps"]}
    text = (submaps_run / "trajectory.txt").read_bytes()
    old = Exposure.from_values(frames["submaps"][1]["exposure"])
    brighter = {1: Exposure(2.0, 0.1).after(old)}
    same, moved = moved_frames(text, frames, anchors, anchors, brighter)
    assert same == text
    assert Exposure.from_values(moved["submaps"][1]["exposure"]) == brighter[1]
    _, same = moved_frames(text, frames, anchors, anchors, {1: old})
    assert json.loads(json.dumps(same)) == frames
    first = frames["submaps"][1]["keyframes"][0]
    last = frames["submaps"][2]["keyframes"][0]
    for old, new in zip(frames["frames"], moved["frames"], strict=True):
        inside = first <= old["index"] < last
        assert new["gain"] == pytest.approx(old["gain"] * (2.0 if inside else 1.0))


def read(folder: Path, name: str) -> str:
    return (folder / name).read_text()


def copy_to(folder: Path, place: str) -> None:
    for path in folder.rglob("*"):
        if path.is_file():
            name = path.relative_to(folder).as_posix()
            storage.write_bytes(storage.join(place, name), path.read_bytes())


def assert_same(folder: Path, place: str) -> None:
    names = [p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()]
    assert "map.ply" in names
    for name in names:
        stored = storage.read_bytes(storage.join(place, name))
        if name != "refine.json":  # names the run
            assert stored == (folder / name).read_bytes(), name
