"""Measuring a run, on a map that is its own truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from box_scene import RenderedDataset, frames_at, poses, rendered_dataset

from toolkit.base.exposure import Exposure
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.runs.evaluation.run_metrics import (
    MeasureOptions,
    TrackedFrame,
    measure_run,
    open_unseen,
)
from toolkit.slam.tracking.rolling_shutter import as_exposed
from toolkit.splatting.gaussians.scene import InMemoryScene


def tracked(T_map_camera, held_out=(), **exposure) -> list[TrackedFrame]:
    return [
        TrackedFrame(i, i / 30.0, T, held_out=i in held_out, **exposure)
        for i, T in enumerate(T_map_camera)
    ]


def test_a_perfect_run_is_measured_as_perfect(gaussians):
    T_map_camera = poses(5, seed=1)
    dataset = rendered_dataset(gaussians, T_map_camera)
    metrics = measure_run(InMemoryScene(gaussians), tracked(T_map_camera, held_out={2}), dataset)
    assert metrics["trajectory"]["ate_rmse_cm"] == pytest.approx(0.0, abs=1e-6)
    assert metrics["trajectory"]["alignment"] == "se3"
    assert metrics["images"]["mapped"]["psnr_db"] > 90.0
    assert metrics["depth"]["mapped"]["l1_cm"] < 1e-3
    assert (metrics["images"]["mapped"]["views"], metrics["images"]["unseen"]["views"]) == (4, 1)


def test_unseen_views_come_into_the_map_by_the_alignment(gaussians):
    T_map_camera = poses(5, seed=1)
    dataset = rendered_dataset(gaussians, T_map_camera)
    unseen = rendered_dataset(gaussians, poses(2, seed=2))
    metrics = measure_run(InMemoryScene(gaussians), tracked(T_map_camera), dataset, unseen)
    assert metrics["images"]["unseen"]["views"] == 2
    assert metrics["images"]["unseen"]["psnr_db"] > 70.0


def test_refining_poses_makes_up_for_a_bad_alignment(gaussians):
    T_map_camera = poses(6, seed=1)
    dataset = rendered_dataset(gaussians, T_map_camera)
    unseen = rendered_dataset(gaussians, poses(2, seed=2))
    shaken = np.stack(
        [
            se3.exp(np.random.default_rng(i).normal(0, 0.02, 6)) @ T
            for i, T in enumerate(poses(6, 1))
        ]
    )
    metrics = measure_run(InMemoryScene(gaussians), tracked(shaken), dataset, unseen)
    assert 0.5 < metrics["trajectory"]["ate_rmse_cm"] < 10.0
    images = metrics["images"]
    assert images["unseen_refined"]["psnr_db"] > images["unseen"]["psnr_db"] + 3.0


def test_with_given_poses_the_map_lies_in_the_world(gaussians):
    T_map_camera = poses(3, seed=1)
    dataset = rendered_dataset(gaussians, T_map_camera)
    unseen = rendered_dataset(gaussians, poses(2, seed=2))
    options = MeasureOptions(alignment="none")
    metrics = measure_run(InMemoryScene(gaussians), tracked(T_map_camera), dataset, unseen, options)
    # The map lies elsewhere here, so that a silent alignment would show.
    assert metrics["trajectory"]["alignment"] == "none"
    # The poses would be compared with themselves.
    assert metrics["trajectory"]["ate_rmse_cm"] is None
    assert metrics["images"]["unseen"]["psnr_db"] < 30.0


def test_exposure_is_taken_back_before_views_are_compared(gaussians):
    T_map_camera = poses(2, seed=1)
    frames = frames_at(gaussians, T_map_camera)
    dark = [Frame(f.index, f.timestamp_s, 0.5 * f.rgb, f.depth_m, f.camera) for f in frames]
    dataset = RenderedDataset(dark, None)
    as_tracked = measure_run(
        InMemoryScene(gaussians), tracked(T_map_camera, exposure=Exposure(2.0)), dataset
    )
    ignored = measure_run(InMemoryScene(gaussians), tracked(T_map_camera), dataset)
    assert as_tracked["images"]["mapped"]["psnr_db"] > 60.0
    assert ignored["images"]["mapped"]["psnr_db"] < 20.0
    assert as_tracked["trajectory"]["ate_rmse_cm"] is None


def test_scores_take_white_balance_back(gaussians):
    T_map_camera = poses(2, seed=1)
    balance = (0.8, 1.0, 1.25)
    frames = frames_at(gaussians, T_map_camera)
    turned = [replace(f, rgb=f.rgb / np.array(balance, np.float32)) for f in frames]
    clipped = [replace(f, rgb=f.rgb.clip(0.0, 1.0)) for f in turned]
    metrics = measure_run(
        InMemoryScene(gaussians),
        tracked(T_map_camera, held_out={1}, exposure=Exposure(balance=balance)),
        RenderedDataset(clipped, None),
    )
    for views in ("mapped", "unseen", "unseen_refined"):
        images = metrics["images"][views]
        assert images["psnr_db"] > 45.0 > 30.0 > images["psnr_one_gain_db"]


def test_long_runs_are_sampled_evenly(gaussians):
    T_map_camera = poses(7, seed=1)
    read = []

    class Watched(RenderedDataset):
        def __getitem__(self, index):
            read.append(index)
            return super().__getitem__(index)

    dataset = Watched(frames_at(gaussians, T_map_camera), None)
    options = MeasureOptions(max_views=3)
    metrics = measure_run(InMemoryScene(gaussians), tracked(T_map_camera), dataset, options=options)
    assert read[:3] == [0, 3, 6]  # those beside them are read afterwards
    assert metrics["images"]["mapped"]["views"] == 3
    assert "at most 3" in metrics["images"]["conventions"]["mapped"]


def test_a_run_without_any_pose_has_no_figures(gaussians):
    metrics = measure_run(
        InMemoryScene(gaussians), [], rendered_dataset(gaussians, poses(2, seed=1))
    )
    assert metrics["images"]["mapped"]["psnr_db"] is None
    assert metrics["trajectory"]["ate_rmse_cm"] is None


def test_a_folder_that_happens_to_be_called_unseen_is_left_alone(tmp_path, caplog):
    assert open_unseen("replica", tmp_path) is None
    (tmp_path / "unseen").mkdir()
    assert open_unseen("replica", tmp_path) is None
    assert "not evaluated" in caplog.text


def test_renderings_are_bent_like_the_images_of_a_rolling_shutter(gaussians):
    step = np.array([0.01, 0.0, 0.02, 0.03, -0.02, 0.01])
    start = poses(1, seed=1)[0]
    T_map_camera = np.stack([start @ se3.exp(n * step) for n in range(5)])
    frames = [
        replace(frame, timestamp_s=n / 30.0, readout_s=0.03)
        for n, frame in enumerate(frames_at(gaussians, T_map_camera))
    ]
    bent = []
    for frame in frames:
        rgb, depth_m = as_exposed(frame.rgb, frame.depth_m, frame, 30.0 * step)
        assert np.abs(rgb - frame.rgb).mean() > 0.005
        bent.append(replace(frame, rgb=rgb, depth_m=depth_m))
    dataset = rendered_dataset(gaussians, T_map_camera)
    path = tracked(T_map_camera, held_out={2})
    metrics = measure_run(InMemoryScene(gaussians), path, replace(dataset, frames=bent))
    assert metrics["images"]["mapped"]["psnr_db"] > 60.0
    assert metrics["images"]["unseen"]["psnr_db"] > 60.0
    assert metrics["images"]["unseen_refined"]["psnr_db"] > 30.0
    ignored = [replace(frame, readout_s=0.0) for frame in bent]
    metrics = measure_run(InMemoryScene(gaussians), path, replace(dataset, frames=ignored))
    assert metrics["images"]["mapped"]["psnr_db"] < 40.0
