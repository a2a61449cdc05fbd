"""A room with a table and two chairs, every Gaussian of which knows what it is."""

from __future__ import annotations

import numpy as np
import torch

from toolkit.base.geometry import se3
from toolkit.io.splat_labels import SplatLabels
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.splatting.gaussians.cloud import GaussianCloud

TAXONOMY = Taxonomy(
    {
        "large items": {
            "building": ["floor", "wall"],
            "furnishings": {"seating": ["chair", "sofa"], "tables": ["table"]},
        },
        "small items": ["cup"],
    },
    levels=["size", "function", "kind", "class"],
    name="room",
)
IDS = {name: number for number, name in enumerate(TAXONOMY.classes, start=1)}
LENGTH_M, WIDTH_M, HEIGHT_M = 4.0, 3.0, 2.5
TABLE_SIZE_M = (1.2, 0.8, 0.75)
CHAIR_SIZE_M = (0.48, 0.44, 0.9)
# Nothing may rely on the map standing upright.
T_MAP_ROOM = se3.exp(np.array([0.3, -0.2, 1.5, 2.0, 0.4, -0.3]))


def sheet(corner: tuple, one: tuple, other: tuple, spacing_m: float = 0.04) -> np.ndarray:
    """Points [N, 3] of a parallelogram, some to its very edges."""
    sides = np.array([one, other], float)
    counts = np.ceil(np.linalg.norm(sides, axis=1) / spacing_m).astype(int) + 1
    a, b = np.meshgrid(*(np.linspace(0.0, 1.0, n) for n in counts))
    return np.array(corner, float) + a.reshape(-1, 1) * sides[0] + b.reshape(-1, 1) * sides[1]


def table(x: float, y: float) -> np.ndarray:
    """A board on two solid sides, its corner at a place on the floor; z is up."""
    length, width, height = TABLE_SIZE_M
    return np.concatenate(
        [
            sheet((x, y, height), (length, 0, 0), (0, width, 0)),
            sheet((x, y, 0), (0, width, 0), (0, 0, height)),
            sheet((x + length, y, 0), (0, width, 0), (0, 0, height)),
        ]
    )


def chair(x: float, y: float) -> np.ndarray:
    """A seat, a back down to the floor, its corner at a place on the floor; z is up."""
    length, width, height = CHAIR_SIZE_M
    return np.concatenate(
        [
            sheet((x, y, 0.45), (length, 0, 0), (0, width, 0)),
            sheet((x, y, 0), (length, 0, 0), (0, 0, height)),
        ]
    )


def room_parts() -> dict[str, np.ndarray]:
    """Points of each class, z up, the floor's corner at the origin."""
    x, y, z = (LENGTH_M, 0, 0), (0, WIDTH_M, 0), (0, 0, HEIGHT_M)
    return {
        "floor": sheet((0, 0, 0), x, y),
        "wall": np.concatenate(
            [
                sheet((0, 0, 0), x, z),
                sheet((0, WIDTH_M, 0), x, z),
                sheet((0, 0, 0), y, z),
                sheet((LENGTH_M, 0, 0), y, z),
            ]
        ),
        "table": table(1.5, 1.0),
        "chair": np.concatenate([chair(1.3, 0.3), chair(2.3, 0.3)]),
    }


def labelled(parts: dict[str, np.ndarray], T_map_room: np.ndarray = T_MAP_ROOM):
    """Centres [N, 3] in the map's frame and their labels."""
    points_m = se3.transform_points(T_map_room, np.concatenate(list(parts.values())))
    ids = np.concatenate([np.full(len(p), IDS[n], np.int32) for n, p in parts.items()])
    return points_m, labels_of(ids)


def labels_of(ids: np.ndarray, confidence: float = 0.9) -> SplatLabels:
    """Labels that are sure of their class."""
    levels = [TAXONOMY.level_ids(ids, level) for level in range(TAXONOMY.depth)]
    sure = np.where(ids > 0, confidence, 0.0).astype(np.float32)
    return SplatLabels(ids.astype(np.int32), np.stack(levels, axis=1), sure)


def gaussians_at(points_m: np.ndarray, ids: np.ndarray) -> GaussianCloud:
    """Solid Gaussians, each class in a colour of its own."""
    shades = np.random.default_rng(0).uniform(0.2, 0.9, (len(TAXONOMY) + 1, 3))
    return GaussianCloud.from_values(
        means=torch.tensor(points_m, dtype=torch.float32),
        radii_m=torch.full((len(points_m),), 0.03),
        opacities=torch.full((len(points_m),), 0.95),
        colours=torch.tensor(shades[ids], dtype=torch.float32),
    )
