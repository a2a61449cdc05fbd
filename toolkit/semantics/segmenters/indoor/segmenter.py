"""Classes of indoor surfaces from depth, agreed on by all views of a place."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.image_sides import ImageSide
from toolkit.semantics.options import GeometricOptions
from toolkit.semantics.segmenters.geometric.labelling import label_cells, label_pixels
from toolkit.semantics.segmenters.geometric.levelled import LevelledGrid
from toolkit.semantics.segmenters.geometric.room import Room
from toolkit.semantics.segmenters.geometric.surface_grid import SurfaceGrid, surface_grid
from toolkit.semantics.segmenters.indoor.channels import indoor_channels
from toolkit.semantics.segmenters.indoor.classes import (
    INDOOR_CLASSES,
    INDOOR_GROUPS,
    INDOOR_KINDS,
    OTHER_FURNITURE,
)
from toolkit.semantics.segmenters.indoor.network import IndoorWeights, load_weights, shipped_weights
from toolkit.semantics.segmenters.indoor.votes import ClassVotes

Values = NDArray[np.float32]

# Maximum number of cells across the image.
INDOOR_COLUMNS = 160
# Probability of the kind (structure, furniture, object) below which a cell is void, and of the
# group below which furniture is only that.
_SURE_KIND, _SURE_GROUP = 0.5, 0.4
# Distance of cells up to which rooms looked like those that the network has learned from, in
# metres. Farther ones are void: streets, halls from their ends, depth in a wrong unit.
_FARTHEST_M = 10.0
# Errors of views of a place depend on each other: 0 if they were independent, 1 if they were equal.
# The value is the likeliest one in rooms that the network has not seen.
_DEPENDENCE = 0.75
_ALIKE = [INDOOR_CLASSES.index(name) for name in ("sofa", "bed")]
_FURNITURE = int(INDOOR_KINDS[INDOOR_CLASSES.index("table")])


class IndoorSegmenter:
    """Labels floor, walls, doors, furniture and objects (`INDOOR_CLASSES`) from depth alone.

    Furniture that may be several things is `OTHER_FURNITURE`.

    A network labels each view. Its probabilities are joined with the structure of the room that
    the geometric segmenter finds, then with those of earlier views in voxels of the map frame. All
    poses must be in the same frame. A frame without a pose is labelled independently and does not
    change the state. Pixels without depth, and those whose kind is in doubt, are void.

    Args:
        options: heights of the camera.
        side: the side of the images that is up.
        weights: file of the network's weights; by default those of the package.

    Raises:
        FormatError: the file of weights is invalid.
    """

    def __init__(
        self,
        options: GeometricOptions | None = None,
        side: ImageSide = "top",
        weights: Path | None = None,
    ) -> None:
        names = (*INDOOR_CLASSES, OTHER_FURNITURE)
        self.class_names: Mapping[int, str] = dict(enumerate(names, start=1))
        self.place_divergence = 0.4
        self._options, self._side = options or GeometricOptions(), side
        self._weights = shipped_weights() if weights is None else load_weights(weights)
        self._room, self._votes = self._new_room(), ClassVotes(len(INDOOR_CLASSES))

    def _new_room(self) -> Room:
        return Room(self._options.camera_height_m, self._side)

    def segment(
        self, frame: Frame, T_map_camera: NDArray[np.float64] | None = None
    ) -> NDArray[np.int32]:
        """Class ids [H, W] from 1 in the order of `class_names`, 0 where they are unknown."""
        grid, log_p = self.cells(frame, T_map_camera)
        classes = np.zeros(grid.valid.shape, np.uint8)
        classes[grid.valid] = _sure_classes(log_p)
        return label_pixels(classes, grid, frame.depth_m, frame.camera)

    def cells(
        self, frame: Frame, T_map_camera: NDArray[np.float64] | None = None
    ) -> tuple[SurfaceGrid, Values]:
        """The cells of a frame, and log probabilities [N, C] of the classes of those with depth."""
        grid = surface_grid(frame.depth_m, frame.camera, INDOOR_COLUMNS)
        if not grid.oriented.any():
            count = int(grid.valid.sum())
            return grid, np.full((count, len(INDOOR_CLASSES)), -np.log(len(INDOOR_CLASSES)))
        room = self._room if T_map_camera is not None else self._new_room()
        pose = np.eye(4) if T_map_camera is None else np.asarray(T_map_camera, dtype=np.float64)
        view = room.update(grid, pose)
        log_p = view_log_probabilities(self._weights, view, room)[:, grid.valid].T
        near = grid.depth_m[grid.valid] <= _FARTHEST_M
        log_p[~near] = -np.log(len(INDOOR_CLASSES))
        if T_map_camera is not None:
            points = se3.transform_points(pose, grid.points[grid.valid].astype(np.float64))
            sums, views = self._votes.add(points[near], log_p[near])
            joined = sums / views[:, None] ** _DEPENDENCE
            log_p[near] = joined - _log_sum(joined, axis=1)
        _join_pieces(log_p, grid.valid)
        return grid, log_p

    def state(self) -> dict[str, NDArray]:
        """Return the structure of the room and the votes."""
        votes = {f"votes/{name}": array for name, array in self._votes.state().items()}
        return {**self._room.state(), **votes}

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        self._room.restore(arrays)
        self._votes.restore({n[6:]: a for n, a in arrays.items() if n.startswith("votes/")})


def view_log_probabilities(weights: IndoorWeights, view: LevelledGrid, room: Room) -> Values:
    """Log probabilities [C, h, w] of one view by the network and by the structure of the room."""
    with torch.no_grad():
        log_p = weights.log_probabilities(levelled_channels(view, room)).numpy()
    log_p += weights.structure[label_cells(view, room)].transpose(2, 0, 1)
    return np.asarray(log_p - _log_sum(log_p, axis=0), dtype=np.float32)


def levelled_channels(view: LevelledGrid, room: Room) -> Tensor:
    """The channels [8, h, w] of a view in a room."""
    floor_m = room.floor_height_m
    below = None if floor_m is None else floor_m - view.camera_height_m
    return torch.from_numpy(indoor_channels(view.grid, view.up_camera, below))


def _sure_classes(log_p: Values) -> NDArray[np.uint8]:
    """Class ids [N] of log probabilities [N, C]: of the likeliest kind, group and class.

    0 where the kind is in doubt, `OTHER_FURNITURE` where only furniture is sure.
    """
    p = np.exp(log_p)
    kinds, groups = p @ _KIND_MEMBERS, p @ _GROUP_MEMBERS
    kind = kinds.argmax(axis=1)
    group = np.where(kind[:, None] == _KIND_OF_GROUP, groups, -1.0).argmax(axis=1)
    found = np.where(group[:, None] == INDOOR_GROUPS, p, -1.0).argmax(axis=1) + 1
    unsure = (kind == _FURNITURE) & (groups.max(axis=1) < _SURE_GROUP)
    found[unsure] = len(INDOOR_CLASSES) + 1
    return np.where(kinds.max(axis=1) >= _SURE_KIND, found, 0).astype(np.uint8)


def _join_pieces(log_p: Values, valid: NDArray[np.bool_]) -> None:
    """Share probability between sofa and bed equally in each connected piece of the two.

    The end of a long sofa looks like a bed; what touches it says what it is. In rooms of all
    families, other classes that the network confuses do not gain from their neighbours.

    Args:
        log_p: [N, C] log probabilities of the valid cells, changed in place.
        valid: [h, w] cells with depth.
    """
    likeliest = np.full(valid.shape, -1)
    likeliest[valid] = log_p.argmax(axis=1)
    _, pieces = cv2.connectedComponents(np.isin(likeliest, _ALIKE).astype(np.uint8))
    piece = pieces[valid]
    if not piece.any():
        return
    p = np.exp(log_p[:, _ALIKE])
    sums = np.stack([np.bincount(piece, values) for values in p.T], axis=1)
    shares = sums / np.maximum(sums.sum(axis=1, keepdims=True), 1e-9)
    inside = piece > 0
    joined = p[inside].sum(axis=1, keepdims=True) * shares[piece[inside]]
    log_p[np.ix_(inside, _ALIKE)] = np.log(np.maximum(joined, 1e-9))


def _members(numbers: NDArray[np.int64]) -> Values:
    """Which classes [C, K] belong to each of K groups."""
    return np.eye(numbers.max() + 1, dtype=np.float32)[numbers]


_KIND_MEMBERS, _GROUP_MEMBERS = _members(INDOOR_KINDS), _members(INDOOR_GROUPS)
_KIND_OF_GROUP = np.array([INDOOR_KINDS[k == INDOOR_GROUPS][0] for k in np.unique(INDOOR_GROUPS)])


def _log_sum(log_p: Values, axis: int) -> Values:
    largest = log_p.max(axis=axis, keepdims=True)
    total = np.exp(log_p - largest).sum(axis=axis, keepdims=True)
    return np.asarray(largest + np.log(total), dtype=np.float32)
