"""Folders of finished runs in synthetic rooms, without SLAM: Gaussians on the true surfaces."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch

from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.synthetic_rooms.layouts import LAYOUTS, Layout, build_parts
from toolkit.datasets.synthetic_rooms.parts import Part
from toolkit.datasets.synthetic_rooms.paths import look_at
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_IDS, CLASS_NAMES
from toolkit.io.splat_labels import SplatLabels
from toolkit.io.splats import write_splat_ply
from toolkit.runs.folder import RunFolder
from toolkit.runs.settings import RunSettings, dump_settings
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.splatting.gaussians.cloud import GaussianCloud

TAXONOMY = Taxonomy({"things": list(CLASS_NAMES)}, classes=CLASS_NAMES, name="rooms")
# Nothing may rely on the map standing upright.
T_MAP_WORLD = se3.exp(np.array([0.3, -0.2, 1.5, 2.0, 0.4, -0.3]))
_FOCAL, _SIZE = 80.0, (128, 96)


def sampled(parts: list[Part], spacing_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Random points [N, 3] on the surfaces, and their classes."""
    rng = np.random.default_rng(0)
    points, ids = [], []
    for part in parts:
        for patch in part.patches:
            a, b, c = np.moveaxis(patch.points.reshape(-1, 3)[patch.triangles()], 1, 0)
            areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
            count = max(1, math.ceil(areas.sum() / spacing_m**2))
            chosen = rng.choice(len(areas), count, p=areas / areas.sum())
            u, v = np.sort(rng.random((2, count)), axis=0)
            along = u[:, None] * (b - a)[chosen] + (v - u)[:, None] * (c - a)[chosen]
            points.append(a[chosen] + along)
            ids.append(np.full(count, CLASS_IDS[part.class_name], np.int32))
    return np.concatenate(points), np.concatenate(ids)


def poses_along(layout: Layout) -> np.ndarray:
    """T_world_camera [K, 4, 4] at the way points of a layout."""
    return np.stack(
        [look_at(np.array(p.position_m), np.array(p.target_m)) for p in layout.way_points]
    )


def make_run(
    folder: Path,
    layout: Layout,
    parts: list[Part],
    taxonomy: Taxonomy = TAXONOMY,
    spacing_m: float = 0.08,
) -> Path:
    """Write the folder of a run that has mapped parts without errors; all frames are keyframes.

    The taxonomy may have other names for the classes of synthetic rooms.
    """
    points, ids = sampled(parts, spacing_m)
    return write_run(folder, points, ids, poses_along(layout), taxonomy, spacing_m)


def write_run(
    folder: Path,
    points: np.ndarray,
    ids: np.ndarray,
    T_world_camera: np.ndarray,
    taxonomy: Taxonomy = TAXONOMY,
    spacing_m: float = 0.08,
) -> Path:
    """Write the folder of a run that has mapped points of the world with their classes."""
    gaussians = GaussianCloud.from_values(
        means=torch.tensor(se3.transform_points(T_MAP_WORLD, points), dtype=torch.float32),
        radii_m=torch.full((len(points),), 0.6 * spacing_m),
        opacities=torch.full((len(points),), 0.95),
        colours=torch.full((len(points), 3), 0.5),
    )
    levels = np.stack([taxonomy.level_ids(ids, level) for level in range(taxonomy.depth)], axis=1)
    labels = SplatLabels(ids, levels, np.full(len(ids), 0.9, np.float32))
    poses = T_MAP_WORLD @ T_world_camera
    settings = RunSettings(dataset=DatasetOptions(kind="synthetic", path=Path("/gone")))
    run = RunFolder.create(folder, dump_settings(settings))
    times = np.arange(len(poses)) / 30.0
    run.write_trajectory(Trajectory(times, poses))
    write_splat_ply(run.map, gaussians, labels.columns())
    taxonomy.save(run.path / "taxonomy.yaml")
    run.write_json(run.frames, _frames(len(poses)))
    return run.path


def changed(parts: list[Part]) -> list[Part]:
    """The parts of a room later: its chair has moved, and its ball is gone."""
    offset = se3.from_rotation_translation(np.eye(3), np.array([1.5, -0.6, 0.0]))
    return [
        part.transformed(offset) if part.class_name == "chair" else part
        for part in parts
        if part.class_name != "exercise-ball"
    ]


def _frames(count: int) -> dict:
    """The content of frames.json: every frame is a tracked keyframe."""
    exposure = {"gain": 1.0, "bias": 0.0, "balance": [1.0, 1.0, 1.0]}
    numbers = range(count)
    part = {
        "number": 0,
        "submaps": [],
        "frames": count,
        "first": 0,
        "last": count - 1,
        "loss": None,
    }
    width, height = _SIZE
    return {
        "frames": [
            {"index": i, "timestamp_s": i / 30.0, **exposure, "held_out": False} for i in numbers
        ],
        "states": [{"index": i, "state": "tracked", "part": 0} for i in numbers],
        "lost": [],
        "keyframes": list(numbers),
        "parts": [part],
        "submaps": [],
        "camera": {
            "fx": _FOCAL,
            "fy": _FOCAL,
            "cx": (width - 1) / 2,
            "cy": (height - 1) / 2,
            "width": width,
            "height": height,
        },
        "metric": True,
    }


def layout_run(folder: Path, name: str) -> Path:
    """The run of a layout by its name."""
    layout = LAYOUTS[name]()
    return make_run(folder, layout, build_parts(layout, 0))
