"""Embeddings of the objects of a labelled map: crops of keyframes, embedded and fused."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from toolkit.base.errors import ToolkitError
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.depth_lookup import depths_at
from toolkit.base.keyframe import evenly_spaced
from toolkit.datasets.base import RecordedDataset
from toolkit.io.object_embeddings import ObjectEmbeddings
from toolkit.io.visualisation import colour_image
from toolkit.runs.evaluation.run_metrics import TrackedFrame
from toolkit.runs.maps.finished import FinishedRun
from toolkit.runs.maps.labelled import LabelledRun
from toolkit.scene.query import SceneObject
from toolkit.semantics.embedding_fusion import FusedEmbedding, fuse_views, view_weights
from toolkit.semantics.taxonomy import VOID
from toolkit.splatting.rendering import backend, render_surface

_log = logging.getLogger(__name__)

Box = tuple[int, int, int, int]

# A Gaussian is visible if it is at most this far behind the rendered surface.
_TOLERANCE_M, _RELATIVE_TOLERANCE = 0.05, 0.02
# Gaussians nearer than this are behind the camera.
_NEAR_M = 0.05
# Views that show less of an object are not used: visible Gaussians and their share, side in pixels.
_MIN_GAUSSIANS, _MIN_SHARE, _MIN_SIDE = 10, 0.15, 16
# The box is that of these percentiles of the visible pixels, plus a margin on every side: encoders
# recognise objects better with some surroundings.
_BOX_PERCENTILES, _MARGIN = (2.0, 98.0), 0.1


class ImageEncoder(Protocol):
    """Embeds images.

    Attributes:
        name: identifies the weights.
    """

    name: str

    def embed_images(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """Return the embeddings [N, D] of RGB images [H, W, 3], of unit length."""


@dataclass(frozen=True)
class EmbeddingOptions:
    """Options of the embedding of objects.

    Attributes:
        max_keyframes: maximum number of keyframes that are searched for views, evenly spaced.
        max_views: maximum number of views of an object.
    """

    max_keyframes: int = 100
    max_views: int = 12


@dataclass(frozen=True)
class ObjectView:
    """A view of an object in a frame of the dataset.

    Attributes:
        number: number of the object.
        frame: index of the frame.
        box: x and y of the first pixel, and of that behind the last.
        weight: weight in the fusion, in [0, 1].
    """

    number: int
    frame: int
    box: Box
    weight: float


def embed_objects(
    labelled: LabelledRun,
    objects: Sequence[SceneObject],
    dataset: RecordedDataset,
    encoder: ImageEncoder,
    options: EmbeddingOptions,
) -> ObjectEmbeddings:
    """Embed the objects of a map; those that no keyframe shows are left out.

    Args:
        labelled: the run.
        objects: its objects; their ids are their numbers in this sequence.
        dataset: the dataset of the run.
        encoder: embeds images.
        options: options.

    Raises:
        ToolkitError: no object is visible in a keyframe, or a frame cannot be read.
    """
    views = best_views(find_views(labelled, objects, options.max_keyframes), options.max_views)
    if not views:
        raise ToolkitError(
            f"{labelled.run.folder.path}: no keyframe shows an object; check the labels with: "
            "semsplat query RUN --list"
        )
    embeddings = _embedded(views, dataset, encoder)
    fused: dict[int, FusedEmbedding] = {}
    for number in sorted({view.number for view in views}):
        rows = [row for row, view in enumerate(views) if view.number == number]
        weights = np.array([views[row].weight for row in rows])
        found = fuse_views(embeddings[rows], weights)
        if found is not None:
            fused[number] = found
    hidden = len(objects) - len(fused)
    _log.info("Embedded %d objects from %d views; %d are hidden.", len(fused), len(views), hidden)
    return collected(objects, fused, encoder.name)


def find_views(
    labelled: LabelledRun, objects: Sequence[SceneObject], max_keyframes: int
) -> list[ObjectView]:
    """Return the views of objects in keyframes whose images the dataset has."""
    run = labelled.run
    chosen = set(run.keyframes)
    frames = [frame for frame in run.tracked if frame.index in chosen and frame.index >= 0]
    found = []
    spaced = evenly_spaced(frames, max_keyframes)
    for frame in tqdm(spaced, "Keyframes", unit="frame", disable=None):
        depth_m = _depth_m(run, frame)
        for number, item in enumerate(objects):
            points_m = labelled.map.means_m[item.index]
            view = _view(number, frame, points_m, depth_m, run.camera)
            if view is not None:
                found.append(view)
    return found


def best_views(views: Sequence[ObjectView], count: int) -> list[ObjectView]:
    """Return at most some views of each object, in the order of the frames.

    The views of an object are divided into parts of consecutive frames, of each of which the view
    with the greatest weight is taken: the best views of all would be nearly the same.
    """
    found: dict[int, list[ObjectView]] = {}
    for view in sorted(views, key=lambda view: view.frame):
        found.setdefault(view.number, []).append(view)
    best = [
        max((seen[place] for place in part), key=lambda view: view.weight)
        for seen in found.values()
        for part in np.array_split(np.arange(len(seen)), min(count, len(seen)))
    ]
    return sorted(best, key=lambda view: (view.frame, view.number))


def _depth_m(run: FinishedRun, frame: TrackedFrame) -> NDArray[np.floating]:
    T_camera_map = se3.inverse(frame.T_map_camera)
    renderer = backend(run.settings.backend)
    surface = render_surface(renderer, run.gaussians, run.camera, T_camera_map)
    return np.asarray(surface.depth_m.numpy())


def _view(
    number: int,
    frame: TrackedFrame,
    points_m: NDArray[np.float64],
    depth_m: NDArray[np.floating],
    camera: Camera,
) -> ObjectView | None:
    """Return the view of an object from its Gaussians [n, 3], None if too little is visible."""
    points_m = se3.transform_points(se3.inverse(frame.T_map_camera), points_m)
    at = depths_at(points_m, depth_m, camera, _NEAR_M)
    limit_m = at.depth_m * (1 + _RELATIVE_TOLERANCE) + _TOLERANCE_M
    visible = (at.depth_m > 0) & (at.z_m <= limit_m)
    share = visible.sum() / len(points_m)
    if visible.sum() < _MIN_GAUSSIANS or share < _MIN_SHARE:
        return None
    box = _box(at.column[visible], at.row[visible], camera)
    width, height = box[2] - box[0], box[3] - box[1]
    if min(width, height) < _MIN_SIDE:
        return None
    distance_m = float(np.median(at.z_m[visible]))
    weight = view_weights(
        np.array([float(width * height)]), np.array([distance_m]), np.array([min(share, 1.0)])
    )
    return ObjectView(number, frame.index, box, float(weight[0]))


def _box(x: NDArray[np.integer], y: NDArray[np.integer], camera: Camera) -> Box:
    (left, right), (top, bottom) = (np.percentile(v, _BOX_PERCENTILES) for v in (x, y))
    dx, dy = _MARGIN * (right - left), _MARGIN * (bottom - top)
    return (
        max(0, int(left - dx)),
        max(0, int(top - dy)),
        min(camera.width, int(right + dx) + 1),
        min(camera.height, int(bottom + dy) + 1),
    )


def _embedded(
    views: Sequence[ObjectView], dataset: RecordedDataset, encoder: ImageEncoder
) -> NDArray[np.float32]:
    """Return the embeddings of views, which are in the order of the frames."""
    found = []
    frames = sorted({view.frame for view in views})
    for index in tqdm(frames, "Embedding", unit="frame", disable=None):
        image = colour_image(dataset[index].rgb)
        boxes = [view.box for view in views if view.frame == index]
        crops = [image[top:bottom, left:right] for left, top, right, bottom in boxes]
        found.append(encoder.embed_images(crops))
    return np.concatenate(found)


def collected(
    objects: Sequence[SceneObject], fused: dict[int, FusedEmbedding], model: str
) -> ObjectEmbeddings:
    """Return objects with embeddings, by their numbers in a sequence of objects."""
    nodes = [objects[number].node for number in fused]
    centres_m = [objects[number].box.centre_m for number in fused]
    instances = np.array([objects[number].instance for number in fused], np.int32)
    return ObjectEmbeddings(
        np.array(list(fused), np.int32),
        np.array([node.class_ids[0] if node.leaf else VOID for node in nodes], np.int32),
        np.stack([found.embedding for found in fused.values()]),
        np.array([found.weight for found in fused.values()], np.float32),
        model,
        np.array(centres_m, np.float32).reshape(-1, 3),
        instances if instances.any() else None,
    )
