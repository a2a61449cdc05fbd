"""What the labels of the geometric segmenter say of the classes of the indoor network."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from data_tools.training_rooms.rooms import random_room
from data_tools.training_rooms.samples import CLASS_IDS
from data_tools.training_rooms.views import RenderedRoom
from toolkit.semantics.options import GeometricOptions
from toolkit.semantics.segmenters.geometric.labelling import OBJECT, label_cells
from toolkit.semantics.segmenters.geometric.room import Room
from toolkit.semantics.segmenters.geometric.surface_grid import surface_grid

_SIZE, _VIEWS = (160, 120), 10
# Both judge by the same depth: the evidence counts less than independent evidence would.
_SHARE = 0.5


def structure_evidence(seed: int, rooms: int) -> NDArray[np.float32]:
    """Logarithms [6, C] of the probability of each label of a cell, given its class.

    Views of a room share what the geometric segmenter knows of it, as in a run.
    """
    counts = np.ones((OBJECT + 1, len(CLASS_IDS)))
    for number in range(rooms):
        rng = np.random.default_rng([seed, number])
        rendered = RenderedRoom(random_room(rng), CLASS_IDS)
        room = Room(GeometricOptions().camera_height_m)
        for _ in range(_VIEWS):
            view = rendered.view(rng, *_SIZE)
            if view is None:
                continue
            grid = surface_grid(view.depth_m, view.camera)
            found = label_cells(room.update(grid, view.T_world_camera), room)
            known = grid.valid & (view.labels > 0)
            np.add.at(counts, (found[known], view.labels[known] - 1), 1.0)
    # No class of this many cells is certain or impossible.
    likelihood = (counts / counts.sum(axis=0)).clip(1e-3)
    return np.asarray(_SHARE * np.log(likelihood), dtype=np.float32)
