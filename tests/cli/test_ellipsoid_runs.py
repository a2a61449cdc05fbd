"""A finished map of ellipsoids, in the hands of every program that takes maps."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from room_runs import RoomRuns

from toolkit.runs.maps.finished import load_run
from toolkit.runs.maps.splat_clouds import read_cloud
from toolkit.splatting.gaussians.cloud import PIXEL_FILTER
from toolkit.splatting.rendering import render
from toolkit.tools.cli.main import main


@pytest.fixture(scope="module")
def run(room_runs: RoomRuns, tmp_path_factory) -> Path:
    return shutil.copytree(room_runs.a, tmp_path_factory.mktemp("ellipsoids") / "run")


def test_the_map_says_how_it_is_rendered(run) -> None:
    finished = load_run(run)
    assert finished.gaussians.ellipsoids is not None
    assert finished.gaussians.low_pass == PIXEL_FILTER


def test_the_file_of_the_map_is_the_map(run) -> None:
    """What other programs read renders like the stored submap."""
    finished = load_run(run)
    stored = finished.submaps[0].gaussians
    T_camera_map = torch.eye(4, dtype=torch.float64)
    images = [
        render(cloud, finished.camera, T_camera_map).silhouette
        for cloud in (read_cloud(run / "map.ply"), stored)
    ]
    assert float((images[0] - images[1]).abs().max()) < 1e-3


@pytest.mark.parametrize(
    "words",
    [
        ("render", "{run}", "--out", "{out}/views", "--every", "4"),
        ("render", "{run}/map.ply", "--out", "{out}/view"),
        ("evaluate", "{run}"),
        ("export", "{run}", "--to", "{out}/map.spz"),
        ("export", "{run}", "--to", "{out}/map.glb"),
        ("export", "{run}", "--format", "viewer", "--to", "{out}/map.html"),
        ("refine", "{run}", "--out", "{out}/refined", "--iterations", "1"),
    ],
)
def test_programs_take_it(run, tmp_path, words) -> None:
    assert main([word.format(run=run, out=tmp_path) for word in words]) == 0


def test_a_camera_is_tracked_in_it(extended) -> None:
    """A second walk is relocalised in the map of ellipsoids, and extends it."""
    more = load_run(extended)
    assert len(more.tracked) > 0 and more.gaussians.ellipsoids is not None
