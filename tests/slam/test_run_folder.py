"""The run folder: two generations of checkpoints, and all that is refused."""

from __future__ import annotations

import json
import logging

import numpy as np
import pytest
import torch

from toolkit.base.errors import RunFolderError, SettingsError
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.runs.folder import MapPart, RunFolder
from toolkit.runs.settings import RunSettings, dump_settings
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.tools.cli.main import main

CONFIG = dump_settings(RunSettings(seed=12))


@pytest.fixture
def folder(tmp_path) -> RunFolder:
    return RunFolder.create(tmp_path / "run", CONFIG)


def save(folder: RunFolder, number: int) -> None:
    folder.checkpoints.save(number, {"a/b": np.full(4, number)}, {"keyframes": number})


def test_a_new_folder_has_no_checkpoint(folder):
    assert folder.checkpoints.load() is None
    assert folder.config.read_text() == CONFIG
    assert folder.renders.is_dir()


def test_the_newest_checkpoint_comes_back_whole(folder):
    for number in range(5):
        save(folder, number)
        checkpoint = RunFolder.open(folder.path).checkpoints.load()
        assert checkpoint.next_frame == number
        assert checkpoint.arrays["a/b"].tolist() == [number] * 4
        assert checkpoint.values == {"keyframes": number}
    assert sorted(p.name for p in folder.checkpoints.path.iterdir()) == ["0", "1"]


@pytest.mark.parametrize("file", ["arrays.npz", "metadata.json"])
@pytest.mark.parametrize("newest", ["0", "1"])
def test_a_damaged_newest_falls_back_to_the_one_before(folder, caplog, file, newest):
    for number in range(3 if newest == "0" else 4):
        save(folder, number)
    last = folder.checkpoints.load().next_frame
    damaged = folder.checkpoints.path / newest / file
    damaged.write_bytes(damaged.read_bytes()[:-20])
    with caplog.at_level(logging.WARNING):
        assert folder.checkpoints.load().next_frame == last - 1
    if file == "arrays.npz":
        assert str(folder.checkpoints.path / newest) in caplog.text


def test_what_a_killed_process_was_writing_is_removed_when_the_run_is_resumed(folder):
    save(folder, 1)
    places = (folder.path, folder.checkpoints.path, folder.submaps, folder.renders)
    for parent in (*places, folder.part(1).path):
        (parent / ".writing-a").mkdir(parents=True)
        (parent / ".writing-a/arrays.npz").write_bytes(b"half")
        (parent / ".replaced-b").mkdir()
        (parent / ".writing-c.ply").write_bytes(b"half")
    folder.remove_leftovers()
    assert not list(folder.path.rglob(".*"))
    assert folder.checkpoints.load().next_frame == 1


def test_after_a_damage_the_good_one_is_not_the_next_to_go(folder):
    for number in range(3):
        save(folder, number)
    (folder.checkpoints.path / "0" / "metadata.json").write_text("{")
    save(folder, 9)
    assert folder.checkpoints.load().next_frame == 9
    (folder.checkpoints.path / "0" / "arrays.npz").write_bytes(b"")
    assert folder.checkpoints.load().next_frame == 1


def test_a_checkpoint_of_another_format_is_not_called_damaged(folder):
    save(folder, 0)
    path = folder.checkpoints.path / "0" / "metadata.json"
    metadata = json.loads(path.read_text())
    metadata["format"] = 1
    path.write_text(json.dumps(metadata))
    with pytest.raises(RunFolderError, match=r"checkpoint format 1.*reads format \d.*new run"):
        folder.checkpoints.load()


def test_a_missing_file_is_a_damage(folder):
    save(folder, 0)
    save(folder, 1)
    (folder.checkpoints.path / "1" / "arrays.npz").unlink()
    assert folder.checkpoints.load().next_frame == 0


def test_nothing_readable_is_an_error(folder):
    for number in range(2):
        save(folder, number)
        (folder.checkpoints.path / str(number) / "arrays.npz").write_bytes(b"no zip")
    with pytest.raises(RunFolderError, match="start a new run"):
        folder.checkpoints.load()


def test_another_thread_count_is_an_error_that_names_the_remedy(folder):
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        save(folder, 0)
        torch.set_num_threads(2)
        with pytest.raises(RunFolderError, match="OMP_NUM_THREADS=1"):
            folder.checkpoints.load()
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("other", [RunSettings(seed=13), RunSettings(seed=12, hold_out=5)])
def test_other_settings_are_an_error(folder, other):
    folder.check_config(CONFIG)
    with pytest.raises(SettingsError, match="other settings"):
        folder.check_config(dump_settings(other))


@pytest.mark.parametrize("stored", [CONFIG + "speed: 5\n", CONFIG.replace("denoise: true\n", "")])
def test_settings_of_another_version_are_an_error(folder, stored):
    folder.config.write_text(stored)
    key = "speed" if "speed" in stored else "denoise"
    with pytest.raises(RunFolderError, match=f"another version .* differ in {key}; resume with"):
        folder.check_config(CONFIG)


def test_a_run_is_not_overwritten(folder):
    with pytest.raises(RunFolderError, match="resume it"):
        RunFolder.create(folder.path, CONFIG)


def test_a_folder_with_other_things_is_not_taken(tmp_path):
    (tmp_path / "holiday.jpg").touch()
    with pytest.raises(RunFolderError, match="not an empty folder"):
        RunFolder.create(tmp_path, CONFIG)
    assert [p.name for p in tmp_path.iterdir()] == ["holiday.jpg"]
    with pytest.raises(RunFolderError, match="not an empty folder"):
        RunFolder.create(tmp_path / "holiday.jpg", CONFIG)


def test_an_empty_folder_is_taken(tmp_path):
    assert RunFolder.create(tmp_path, CONFIG).config.exists()


def test_only_runs_are_opened(tmp_path):
    for path in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(RunFolderError, match="contains no run"):
            RunFolder.open(path)


def test_trajectory_and_map_come_back(folder):
    poses = np.stack([se3.exp(0.1 * i * np.arange(6.0)) for i in range(4)])
    folder.write_trajectory(Trajectory(np.arange(4) / 30.0, poses))
    assert np.allclose(folder.read_trajectory().T_world_camera, poses, atol=1e-6)
    generator = torch.Generator().manual_seed(0)
    cloud = GaussianCloud.from_values(
        torch.randn(9, 3, generator=generator),
        torch.rand(9, generator=generator) + 0.01,
        torch.full((9,), 0.7),
        torch.rand(9, 3, generator=generator),
    )
    folder.write_map([MapPart(cloud)])
    found = folder.read_map()
    for name in ("means", "log_radii", "opacity_logits", "colours"):
        assert torch.allclose(getattr(found, name), getattr(cloud, name), atol=1e-5), name


def test_a_folder_that_came_to_nothing_can_be_made_again(tmp_path):
    folder = RunFolder.create(tmp_path / "run", "seed: 0\n")
    folder.discard()
    assert not folder.path.exists()
    RunFolder.create(tmp_path / "run", "seed: 0\n")


def test_what_a_run_wrote_is_not_taken_back(tmp_path):
    folder = RunFolder.create(tmp_path / "run", "seed: 0\n")
    (folder.renders / "view.png").write_bytes(b"view")
    folder.discard()
    assert (folder.renders / "view.png").exists()


def test_a_finished_run_has_one_copy_of_its_map_and_nothing_to_resume(submaps_run, caplog):
    caplog.set_level("INFO")
    assert not any((submaps_run / "checkpoint").iterdir())
    names = [path.name for path in (submaps_run / "submaps").iterdir()]
    assert len({name.split("_")[0] for name in names}) == len(names) > 1
    before = (submaps_run / "metrics.json").stat().st_mtime_ns
    config = str(submaps_run / "config.yaml")
    assert main(["run", "--config", config, "--out", str(submaps_run), "--resume"]) == 0
    assert "is finished; there is nothing to resume" in caplog.text
    assert (submaps_run / "metrics.json").stat().st_mtime_ns == before
