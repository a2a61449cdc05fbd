"""run --map FILE: the camera is found in a splat file of unknown scale, which is extended."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from room_runs import make_recordings, walk
from test_run_in_saved_map import error_of, stopped_after

from toolkit.base.errors import SettingsError
from toolkit.base.geometry import se3
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.datasets.synthetic_rooms.writer import prepare_folder, write_sequence
from toolkit.io.splats import export_splats, read_splats
from toolkit.runs.maps.finished import load_run
from toolkit.runs.maps.saved_map import open_saved_map
from toolkit.runs.maps.splat_clouds import read_cloud
from toolkit.runs.settings import RunSettings
from toolkit.tools.cli.main import main

UNITS_PER_METRE = 2.5
T_FILE_WORLD = se3.exp(np.array([3.0, -2.0, 0.5, 0.9, -1.7, 0.6]))


class Splats(NamedTuple):
    """A splat file without labels, and a recording of the same place.

    Attributes:
        T_map_camera: [9, 4, 4] true poses of the recording in the axes of the file, in metres.
    """

    file: Path
    recording: Path
    T_map_camera: np.ndarray


@pytest.fixture(scope="module")
def splats(tmp_path_factory) -> Splats:
    """A map of the first walk in another unit and other axes, as another tool would write it."""
    folder = tmp_path_factory.mktemp("splats")
    (first, second), T_a_b = make_recordings(folder, 160, 120)
    assert main(walk(first, folder / "a")) == 0
    cloud = read_cloud(folder / "a/map.ply").scaled(UNITS_PER_METRE)
    export_splats(folder / "map.ply", cloud.transformed(T_FILE_WORLD))
    truth = tiny_room(14, 160, 120)[1].T_world_camera[13:4:-1]
    T_file_metres = T_FILE_WORLD.copy()
    T_file_metres[:3, 3] /= UNITS_PER_METRE
    T_a_camera = T_a_b @ se3.inverse(truth[0]) @ truth
    return Splats(folder / "map.ply", second, T_file_metres @ T_a_camera)


@pytest.fixture(scope="module")
def extended(splats, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("extended") / "run"
    assert main(walk(splats.recording, out, "--map", str(splats.file))) == 0
    return out


def test_the_camera_is_found_and_the_map_is_in_metres(extended, splats):
    source = json.loads((extended / "saved_map.json").read_text())
    assert source["file"] == str(splats.file)
    assert source["metres_per_unit"] == pytest.approx(1 / UNITS_PER_METRE, rel=5e-3)
    assert len(source["located_frames"]) >= 2
    said = f"One unit of the file is {source['metres_per_unit']:.4g} m"
    assert said in (extended / "log.txt").read_text()
    run = load_run(extended)
    assert not run.lost and [frame.index for frame in run.tracked] == list(range(9))
    for frame in run.tracked:
        difference = se3.inverse(splats.T_map_camera[frame.index]) @ frame.T_map_camera
        assert np.linalg.norm(difference[:3, 3]) < 0.03


def test_the_map_is_extended_and_labelled(extended, splats):
    map_ = read_splats(extended / "map.ply")
    submap, label = map_.extra["submap"], map_.labels.label
    assert set(submap.tolist()) == {0, 1}
    assert (label[submap == 1] > 0).mean() > 0.95
    assert 0.1 < (label[submap == 0] > 0).mean() < 1.0, "of what the recording shows"
    low, high = (f(map_.means[submap == 1], axis=0) for f in (np.min, np.max))
    before = read_splats(splats.file).means / UNITS_PER_METRE
    assert (low < before.min(axis=0)).any() or (high > before.max(axis=0)).any()


def test_refinement_keeps_the_file_and_improves_the_rest(extended, tmp_path):
    refined = tmp_path / "refined"
    assert main(["refine", str(extended), "--out", str(refined), "--iterations", "16"]) == 0
    psnr_db = []
    for run in (extended, refined):
        assert main(["evaluate", str(run), "--max-views", "4"]) == 0
        metrics = json.loads((run / "metrics.json").read_text())
        psnr_db.append(metrics["images"]["mapped"]["psnr_db"])
    assert psnr_db[1] > psnr_db[0] + 0.2
    before, after = (load_run(run).submaps[0].gaussians for run in (extended, refined))
    np.testing.assert_array_equal(before.means, after.means)


def test_it_resumes_to_the_same_without_the_file(extended, splats, tmp_path, monkeypatch):
    # The path of the file is one of the settings.
    aside, out = tmp_path / "aside.ply", tmp_path / "run"
    words = walk(splats.recording, out, "--map", str(splats.file))
    words += ["--checkpoint.every-keyframes", "1"]
    with monkeypatch.context() as patch:
        stopped_after(4, patch)
        assert main(words) == 130
    shutil.move(splats.file, aside)
    try:
        assert main([*words, "--resume"]) == 0
    finally:
        shutil.move(aside, splats.file)
    for name in ("trajectory.txt", "map.ply", "saved_map.json"):
        assert (out / name).read_bytes() == (extended / name).read_bytes(), name


def test_a_recording_of_another_room_is_refused(splats, tmp_path, capsys):
    frames, truth = tiny_room(3, 160, 120, seed=5)
    recording = tmp_path / "other"
    prepare_folder(recording)
    write_sequence(recording, frames, frames[0].camera, truth.T_world_camera)
    words = walk(recording, tmp_path / "run", "--map", str(splats.file))
    line = error_of(capsys, words)
    assert "other does not match the map" in line and str(splats.file) in line
    assert not (tmp_path / "run").exists(), "so that the same --out can be given again"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--loops.features.source", "both"], "--loops.features.source rgb"),
        (["--poses", "given"], "poses 'slam'"),
        (["--loops.no-use"], "loops.use"),
        (["--depth", "none"], "--map needs depth images"),
        (["--map", "nothing.ply"], "nothing.ply does not exist"),
        (["--map", "map.lcc"], "convert it to .ply"),
    ],
)
def test_bad_input(splats, tmp_path, capsys, words, said):
    run = walk(splats.recording, tmp_path / "run", "--map", str(splats.file), *words)
    assert said in error_of(capsys, run)
    assert not (tmp_path / "run").exists()


def test_a_camera_without_recording_cannot_scale_the_file(splats):
    with pytest.raises(SettingsError, match="use semsplat run, and give the folder of that run"):
        open_saved_map(RunSettings(map=splats.file), None)
