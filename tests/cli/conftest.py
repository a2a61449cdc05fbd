"""A recording of the box on disk, and the folder of a run over it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from box_scene import CAMERA, T_WORLD_MAP, box_map, frames_at, frames_content, poses
from labelled_run import make_labelled_run
from room_runs import RoomRuns, make_room_runs, walk

from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.synthetic_rooms.writer import prepare_folder, write_sequence
from toolkit.runs.folder import MapPart, RunFolder
from toolkit.runs.settings import RunSettings, dump_settings
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.tools.cli.main import main


@pytest.fixture(scope="session")
def gaussians() -> GaussianCloud:
    return box_map()


@pytest.fixture(scope="session")
def recording(tmp_path_factory, gaussians) -> Path:
    """Ten frames on disk in Replica's layout, with two more in `unseen/`."""
    folder = tmp_path_factory.mktemp("recording") / "box"
    prepare_folder(folder)
    for path, T_map_camera in ((folder, poses(10, seed=1)), (folder / "unseen", poses(2, seed=2))):
        frames = frames_at(gaussians, T_map_camera)
        write_sequence(path, frames, CAMERA, T_WORLD_MAP @ T_map_camera)
    return folder


@pytest.fixture
def run(tmp_path, gaussians, recording) -> Path:
    """The folder of a run that was perfect; frame 9 is lost, 4 held out."""
    settings = RunSettings(dataset=DatasetOptions(kind="synthetic", path=recording), hold_out=5)
    folder = RunFolder.create(tmp_path / "run", dump_settings(settings))
    kept = range(9)
    times = np.array([i / 30.0 for i in kept])
    folder.write_trajectory(Trajectory(times, poses(10, seed=1)[:9]))
    folder.write_map([MapPart(gaussians)])
    folder.write_json(folder.frames, frames_content(9, [0, 5], held_out=[4], lost=[9]))
    metrics = {
        "time": {"tracking_ms_per_frame": 12.5},
        "images": {"mapped": {"psnr_db": 1.0}},
    }
    folder.write_json(folder.metrics, metrics)
    return folder.path


@pytest.fixture(scope="session")
def room_runs(tmp_path_factory) -> RoomRuns:
    return make_room_runs(tmp_path_factory.mktemp("room_runs"))


@pytest.fixture(scope="session")
def extended(room_runs, tmp_path_factory) -> Path:
    """The second walk, mapped in the first one's map."""
    out = tmp_path_factory.mktemp("extended") / "run"
    assert main(walk(room_runs.recordings[1], out, "--map", str(room_runs.a))) == 0
    return out


@pytest.fixture(scope="session")
def labelled_run(tmp_path_factory) -> Path:
    """A run in the labelled room. Read only: copy it to change it."""
    return make_labelled_run(tmp_path_factory.mktemp("labelled"))
