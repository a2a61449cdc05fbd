"""`import toolkit`: its public names, and that Python and `semsplat run` give the same result."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

import toolkit
from toolkit.base.errors import DatasetError
from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.io.splats import write_splat_ply
from toolkit.io.trajectories import write_tum
from toolkit.runs.maps.splat_clouds import read_cloud
from toolkit.tools.cli.main import main

README = Path(__file__).resolve().parents[2] / "README.md"


def readme_examples() -> list[str]:
    """The Python blocks of README's section "From Python"."""
    section = README.read_text(encoding="utf-8").split("\n## From Python\n")[1].split("\n## ")[0]
    return re.findall(r"```python\n(.*?)```", section, flags=re.DOTALL)


def test_every_public_name_can_be_imported_and_is_listed():
    for name in toolkit.__all__:
        assert getattr(toolkit, name).__name__ == name
    assert set(toolkit.__all__) <= set(dir(toolkit))


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="build_slamm"):
        toolkit.build_slamm  # noqa: B018 - the access is what raises


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def default_dtype(request) -> Iterator[None]:
    """The dtype of new tensors that a program has chosen."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(request.param)
    yield
    torch.set_default_dtype(before)


@pytest.mark.usefixtures("default_dtype")
def test_the_readme_example_gives_the_same_result_as_semsplat_run(
    tiny_recording, tiny_run, tmp_path, monkeypatch
):
    example = readme_examples()[0]
    assert len([line for line in example.splitlines()[1:] if line.strip()]) == 5
    (tmp_path / "mine").symlink_to(tiny_recording)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(example, names)
    slam = names["slam"]
    write_tum("trajectory.txt", slam.result().trajectory)
    assert Path("trajectory.txt").read_bytes() == (tiny_run / "trajectory.txt").read_bytes()
    write_splat_ply("map.ply", slam.result().gaussians)
    ours, theirs = read_cloud("map.ply"), read_cloud(tiny_run / "map.ply")
    for name in ("means", "log_radii", "opacity_logits", "colours"):
        a, b = (getattr(cloud, name).numpy() for cloud in (ours, theirs))
        np.testing.assert_array_equal(a, b, err_msg=name)


def test_the_camera_loop_of_the_guide_runs(tmp_path, monkeypatch):
    frames, _ = tiny_room(3, 64, 48)
    guide = README.parent / "docs" / "guides" / "python.md"
    section = guide.read_text(encoding="utf-8").split("## Process images of a camera\n")[1]
    block = section.split("```python\n")[1].split("```")[0]
    example, count = re.subn(r"toolkit\.Camera\(.*\)", "CAMERA", block)
    assert count == 1
    images = [
        (f.timestamp_s, np.rint(255 * f.rgb).astype(np.uint8), (1000 * f.depth_m).astype(np.uint16))
        for f in frames
    ]
    monkeypatch.chdir(tmp_path)
    exec(example, {"images": images, "CAMERA": frames[0].camera})
    assert (tmp_path / "map.ply").stat().st_size > 10_000


def test_run_from_python_writes_the_same_folder_as_the_command(tiny_recording, tiny_run, tmp_path):
    dataset = DatasetOptions(kind="folder", path=tiny_recording)
    toolkit.run(toolkit.RunSettings(dataset=dataset), tmp_path / "run")
    for name in ("trajectory.txt", "map.ply", "loops.jsonl", "config.yaml"):
        assert (tmp_path / "run" / name).read_bytes() == (tiny_run / name).read_bytes(), name


def test_a_run_is_loaded_evaluated_and_rendered(tiny_run, tiny_recording):
    run = toolkit.load_run(tiny_run)
    metrics = toolkit.evaluate(run, max_views=2)
    assert metrics["frames"]["total"] == len(run.trajectory) == 6
    assert metrics["trajectory"]["ate_rmse_cm"] < 1.0
    camera = toolkit.open_dataset("folder", tiny_recording).camera
    assert isinstance(camera, toolkit.Camera)
    T_camera_map = np.linalg.inv(run.trajectory.T_world_camera[0])
    rendering = toolkit.render(run.gaussians, camera, T_camera_map)
    assert rendering.colour.shape == (48, 64, 3)
    assert rendering.silhouette.mean() > 0.5


def test_given_poses_without_a_dataset_are_refused():
    with pytest.raises(DatasetError, match="needs poses"):
        toolkit.build_slam(settings=toolkit.RunSettings(poses="given"))


def test_the_command_evaluates_to_the_same_metrics(tiny_run, tmp_path):
    copy = shutil.copytree(tiny_run, tmp_path / "run")
    assert main(["evaluate", str(copy)]) == 0
    metrics = toolkit.evaluate(toolkit.load_run(copy))
    written = (copy / "metrics.json").read_text()
    assert f'"psnr_db": {metrics["images"]["mapped"]["psnr_db"]}' in written
