"""Scenes of any size: the same room at 6 cm, 3 m and 90 m gives the same map and trajectory."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from killed_runs import kept_checkpoints

from toolkit.base.frame import Frame
from toolkit.base.geometry.frustum import Frustum
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.base.options import validated
from toolkit.datasets.registry import open_dataset
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.io import images
from toolkit.io.trajectories import write_tum
from toolkit.runs.building import build_slam
from toolkit.runs.execution import run
from toolkit.runs.maps.finished import load_run
from toolkit.runs.settings import RunSettings
from toolkit.slam.length_unit import LengthUnit
from toolkit.slam.result import FrameResult
from toolkit.slam.tracking.result import not_tracked
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.tools.cli.main import main

FRAMES, SIZE = 8, (80, 60)


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """A small room in metres, as a folder."""
    folder = tmp_path_factory.mktemp("room") / "metres"
    frames, truth = tiny_room(FRAMES, *SIZE)
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    for frame in frames:
        images.write_rgb(folder / f"rgb/{frame.index:04d}.png", frame.rgb)
        images.write_depth_png(folder / f"depth/{frame.index:04d}.png", frame.depth_m, 8000.0)
    camera = frames[0].camera
    values = {n: getattr(camera, n) for n in ("fx", "fy", "cx", "cy", "width", "height")}
    text = yaml.safe_dump(values | {"depth_scale": 8000.0, "fps": 30.0})
    (folder / "intrinsics.yaml").write_text(text)
    write_tum(folder / "trajectory.txt", truth)
    return folder


def scaled(room: Path, place: Path, factor: float) -> Path:
    """The room, multiplied by a factor."""
    place.mkdir()
    for name in ("rgb", "depth"):
        (place / name).symlink_to(room / name)
    values = yaml.safe_load((room / "intrinsics.yaml").read_text())
    values["depth_scale"] /= float(factor)
    (place / "intrinsics.yaml").write_text(yaml.safe_dump(values))
    dataset = open_dataset("folder", room)
    poses = np.array(dataset.ground_truth.T_world_camera)
    poses[:, :3, 3] *= factor
    write_tum(place / "trajectory.txt", Trajectory(dataset.ground_truth.timestamps_s, poses))
    return place


def settings(place: Path, **values) -> RunSettings:
    content = {"dataset": {"kind": "folder", "path": str(place)}, "checkpoint": {"every_s": 1e9}}
    return validated(RunSettings, content | {"mapping": {"final_iterations": 2}} | values)


@pytest.fixture(scope="module")
def runs(room, tmp_path_factory) -> dict[float, Path]:
    """Finished runs by factor."""
    folder, found = tmp_path_factory.mktemp("runs"), {}
    for factor in (1.0, 1 / 50, 30.0):
        place = scaled(room, folder / f"room{factor:g}", factor)
        run(settings(place), folder / f"run{factor:g}")
        found[factor] = folder / f"run{factor:g}"
    return found


@pytest.mark.parametrize("factor", [1 / 50, 30.0])
def test_the_size_of_a_scene_does_not_matter(runs, factor):
    here, there = (json.loads((runs[f] / "metrics.json").read_text()) for f in (1.0, factor))
    assert there["frames"]["lost"] == there["frames"]["doubtful"] == 0
    assert there["images"]["mapped"]["psnr_db"] > here["images"]["mapped"]["psnr_db"] - 0.5
    ate_cm, l1_cm = here["trajectory"]["ate_rmse_cm"], here["depth"]["mapped"]["l1_cm"]
    assert there["trajectory"]["ate_rmse_cm"] / factor == pytest.approx(ate_cm, abs=0.05)
    assert there["depth"]["mapped"]["l1_cm"] / factor == pytest.approx(l1_cm, rel=0.3)
    finished = load_run(runs[factor])
    path_m = load_run(runs[1.0]).trajectory.path_length_m
    assert finished.trajectory.path_length_m / factor == pytest.approx(path_m, rel=0.05)
    # Maps, covariances and submaps are in metres as well.
    (submap,) = finished.submaps.values()
    depth_m = submap.keyframes[0].depth_m
    dataset = finished.open_dataset()
    np.testing.assert_allclose(
        np.median(depth_m[depth_m > 0]), np.median(dataset[0].depth_m), rtol=0.01
    )
    np.testing.assert_allclose(
        submap.gaussians.means.mean(0), finished.gaussians.means.mean(0), atol=0.1 * factor
    )


def test_a_small_map_is_refined_and_continued(runs, room, tmp_path):
    run_folder = runs[1 / 50]
    before = json.loads((run_folder / "metrics.json").read_text())
    assert main(["refine", str(run_folder), "--out", str(tmp_path / "refined")]) == 0
    assert main(["evaluate", str(tmp_path / "refined")]) == 0
    refined = load_run(tmp_path / "refined")
    assert len(refined.gaussians) > 0.8 * len(load_run(run_folder).gaussians)
    np.testing.assert_allclose(
        refined.gaussians.means.mean(0), load_run(run_folder).gaussians.means.mean(0), atol=0.002
    )
    place = load_run(run_folder).settings.dataset.path
    run(settings(place, map=str(run_folder)), tmp_path / "continued")
    stored = [load_run(path).submaps[0] for path in (run_folder, tmp_path / "continued")]
    np.testing.assert_allclose(stored[1].gaussians.means, stored[0].gaussians.means, atol=1e-6)
    after = json.loads((tmp_path / "continued" / "metrics.json").read_text())
    assert after["frames"]["lost"] == 0
    assert after["images"]["mapped"]["psnr_db"] > before["images"]["mapped"]["psnr_db"] - 3.0


def test_an_interrupted_run_of_a_large_scene_is_resumed(runs, tmp_path):
    place = load_run(runs[30.0]).settings.dataset.path
    content = settings(place, checkpoint={"every_keyframes": 1})
    with kept_checkpoints():
        run(content, tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "submaps")
    (tmp_path / "run" / "map.ply").unlink()
    (tmp_path / "run" / "submaps").mkdir()
    run(content, tmp_path / "run", resume=True)
    (reference,) = load_run(runs[30.0]).submaps.values()
    (resumed,) = load_run(tmp_path / "run").submaps.values()
    np.testing.assert_array_equal(resumed.gaussians.means, reference.gaussians.means)


@pytest.mark.parametrize("factor", [1 / 50, 30.0])
def test_without_a_dataset_the_unit_follows_from_the_first_frame(factor):
    """As with a live camera, or with frames from your own code."""
    frames, truth = tiny_room(FRAMES, *SIZE)
    slam = build_slam()
    blank = replace(frames[0], depth_m=np.zeros_like(frames[0].depth_m))
    slam.process_frame(replace(blank, index=0, timestamp_s=-1.0))
    assert slam.unit.is_metre
    for frame in frames:
        depth_m = frame.depth_m * np.float32(factor)
        result = slam.process_frame(replace(frame, index=frame.index + 1, depth_m=depth_m))
        assert not result.lost
    assert not slam.unit.is_metre
    restored = build_slam()
    restored.restore(*slam.state())
    assert restored.unit == slam.unit
    positions = slam.finish().trajectory.positions_m / factor
    path = np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()
    assert path == pytest.approx(truth.path_length_m, rel=0.1)


def test_depth_at_infinity_does_not_count(caplog):
    """As simulators write it for the sky, which may be most of an image."""
    frame = tiny_room(1, *SIZE)[0][0]
    depth_m = np.where(np.arange(frame.depth_m.size) % 5 > 0, np.float32(np.inf), np.float32(3.0))
    depth_m = depth_m.reshape(frame.depth_m.shape)
    assert LengthUnit.of_frame(replace(frame, depth_m=depth_m)) == LengthUnit()
    assert LengthUnit.of_frame(replace(frame, depth_m=np.full_like(depth_m, np.inf))) is None
    assert not caplog.records


def test_depth_in_millimetres_is_warned_of(caplog):
    frame = tiny_room(1, *SIZE)[0][0]
    LengthUnit.of_frame(replace(frame, depth_m=frame.depth_m * 1000))
    assert "km; depth must be in metres" in caplog.text


def test_units_are_powers_of_two_and_rooms_keep_the_metre(room, tmp_path):
    dataset = open_dataset("folder", room)
    median_m = np.median([np.median(frame.depth_m) for frame in dataset])
    assert LengthUnit.of(dataset).is_metre
    assert LengthUnit.of(None) is None
    small = open_dataset("folder", scaled(room, tmp_path / "small", 0.1 / median_m))
    assert LengthUnit.of(small).per_metre in (16.0, 32.0)
    large = open_dataset("folder", scaled(room, tmp_path / "large", 50.0 / median_m))
    assert LengthUnit.of(large).per_metre == 1 / 32


def test_conversions_are_exact_and_metres_are_not_touched():
    cloud = GaussianCloud.from_values(
        torch.rand(5, 3), torch.rand(5) + 0.1, torch.full((5,), 0.5), torch.rand(5, 3)
    )
    unit = LengthUnit(32.0)
    back = unit.cloud_in_metres(unit.cloud(cloud))
    assert torch.equal(back.means, cloud.means)
    torch.testing.assert_close(back.radii_m, cloud.radii_m)
    assert LengthUnit().cloud(cloud) is cloud
    record = {"kind": "found", "apart_m": 3.2, "query": 4, "T_match_query": list(np.eye(4).ravel())}
    record["T_match_query"][3] = 6.4
    converted = unit.record_in_metres(record)
    assert converted["apart_m"] == pytest.approx(0.1)
    assert converted["T_match_query"][3] == pytest.approx(0.2)
    assert converted["T_match_query"][0] == 1.0
    assert (converted["kind"], converted["query"]) == ("found", 4)


def test_the_near_plane_of_a_small_scene_is_nearer():
    dataset_frame: Frame = tiny_room(1, *SIZE)[0][0]
    assert Frustum(dataset_frame.camera, np.eye(4), far_m=4.0).near_m == 0.1
    assert Frustum(dataset_frame.camera, np.eye(4), far_m=0.05).near_m == pytest.approx(0.005)


def test_the_covariance_of_a_frame_is_in_metres():
    unit = LengthUnit(10.0)
    tracking = replace(not_tracked(""), covariance=np.eye(6), information=np.eye(6))
    result = unit.frame_result_in_metres(FrameResult(0, None, tracking))
    assert result.tracking is not None and result.tracking.covariance is not None
    np.testing.assert_allclose(np.diag(result.tracking.covariance), [0.01] * 3 + [1.0] * 3)
    np.testing.assert_allclose(np.diag(result.tracking.information), [100.0] * 3 + [1.0] * 3)
