"""The folder of a finished run with labels, without SLAM: a room with a table and two chairs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from box_scene import CAMERA, T_WORLD_MAP, frames_at, frames_content
from labelled_room import T_MAP_ROOM, TAXONOMY, gaussians_at, labelled, room_parts

from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.synthetic_rooms.writer import prepare_folder, write_sequence
from toolkit.io.splats import write_splat_ply
from toolkit.runs.folder import RunFolder
from toolkit.runs.settings import RunSettings, dump_settings

PLACES = ((0.6, 2.2, 1.7), (3.3, 2.4, 1.6), (2.0, 2.7, 1.9))
TARGET = (2.1, 1.2, 0.5)


def looking(place: tuple, target: tuple) -> np.ndarray:
    """T_map_camera [4, 4] from a place in the room towards another, held upright."""
    forward = np.subtract(target, place)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0, 0, 1.0))
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward], axis=1)
    return T_MAP_ROOM @ se3.from_rotation_translation(R, np.array(place))


def make_labelled_run(folder: Path) -> Path:
    """A run in the labelled room; its truth lies in a world of its own."""
    points_m, labels = labelled(room_parts())
    gaussians = gaussians_at(points_m, labels.label)
    poses = np.stack([looking(place, TARGET) for place in PLACES])
    prepare_folder(folder / "recording")
    write_sequence(folder / "recording", frames_at(gaussians, poses), CAMERA, T_WORLD_MAP @ poses)
    settings = RunSettings(dataset=DatasetOptions(kind="synthetic", path=folder / "recording"))
    run = RunFolder.create(folder / "run", dump_settings(settings))
    times = np.arange(len(poses)) / 30.0
    run.write_trajectory(Trajectory(times, poses))
    write_splat_ply(run.map, gaussians, labels.columns())
    TAXONOMY.save(run.path / "taxonomy.yaml")
    run.write_json(run.frames, frames_content(len(poses), [0]))
    return run.path
