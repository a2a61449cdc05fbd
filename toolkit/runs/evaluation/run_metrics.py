"""Evaluate the trajectory and the map of a run against its dataset.

`semsplat run` and `semsplat evaluate` both call `measure_run`, so evaluating a run again gives the
same metrics, up to the rounding of values in files. Views are read one at a time.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import ToolkitError
from toolkit.base.exposure import IDENTITY, Exposure
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.base import Dataset
from toolkit.datasets.prefetch import prefetched
from toolkit.datasets.registry import open_dataset
from toolkit.runs.evaluation.expected_quality import MAX_COMPARED_VIEWS, expected_metrics
from toolkit.runs.evaluation.free_space import free_space_metrics
from toolkit.runs.evaluation.images import psnr_db
from toolkit.runs.evaluation.lpips import Lpips
from toolkit.runs.evaluation.metrics import (
    IMAGE_CONVENTIONS,
    Metrics,
    ViewQuality,
    depth_metrics,
    image_metrics,
    trajectory_metrics,
    view_quality,
)
from toolkit.runs.evaluation.neighbouring_images import SmallView
from toolkit.runs.evaluation.rendered_views import (
    MIN_SILHOUETTE,
    EvaluatedView,
    RenderedView,
    render_view,
)
from toolkit.runs.evaluation.semantic_views import (
    SemanticEvaluation,
    SemanticScores,
    semantic_metrics,
)
from toolkit.runs.evaluation.trajectory import (
    AlignmentKind,
    TrajectoryAlignment,
    absolute_trajectory_error,
)
from toolkit.runs.evaluation.walls import wall_thickness
from toolkit.slam.mapping.depth_views import DepthImage, DepthView
from toolkit.slam.tracking.dense import DenseTracker
from toolkit.slam.tracking.rolling_shutter import rectified, steady_velocity
from toolkit.splatting.gaussians.scene import GaussianScene

_log = logging.getLogger(__name__)

_DEPTH_CONVENTION = (
    "mean over views of the mean over pixels with measured and rendered depth; rendered depth: "
    "where the ray meets the surface through the weighted mean of centres, in pixels with "
    f"silhouette at least {MIN_SILHOUETTE}"
)


@dataclass(frozen=True)
class TrackedFrame:
    """Pose and exposure of a tracked frame.

    Attributes:
        index: index in the dataset.
        timestamp_s: timestamp in seconds.
        T_map_camera: [4, 4] float64 pose in the map's frame.
        exposure: exposure of the observed image against the map.
        held_out: whether the frame was excluded from mapping.
    """

    index: int
    timestamp_s: float
    T_map_camera: NDArray[np.float64]
    exposure: Exposure = IDENTITY
    held_out: bool = False


@dataclass(frozen=True)
class MeasureOptions:
    """Options of the evaluation of a run.

    Attributes:
        backend_name: the renderer.
        alignment: "se3" for estimated poses, "sim3" if their scale is unknown; "none" for maps
            built from ground-truth poses, in whose frame they are.
        max_views: maximum number of evaluated views in each group (mapped, held out, unseen),
            evenly spaced.
        semantics: decoder and class names, None for a map without semantics.
        mesh: file of the ground-truth mesh in the frame of the ground truth, or None.
        lpips: network of LPIPS, or None without its weights.
        uses_depth: whether the map follows from measured depth.
    """

    backend_name: str = "auto"
    alignment: AlignmentKind = "se3"
    max_views: int = 100
    semantics: SemanticEvaluation | None = None
    mesh: Path | None = None
    lpips: Lpips | None = None
    uses_depth: bool = True


def measure_run(
    scene: GaussianScene,
    tracked: Sequence[TrackedFrame],
    dataset: Dataset,
    unseen: Dataset | None = None,
    options: MeasureOptions | None = None,
) -> Metrics:
    """Compute the metrics of a run from its map, its poses and the dataset.

    Args:
        scene: the final map.
        tracked: all frames with a pose, in order of time.
        dataset: frames, and ground truth if available.
        unseen: additional views with ground-truth poses in the frame of `dataset`, or None.
        options: evaluation options; defaults if absent.

    Returns:
        The groups "trajectory", "images", "depth", "expected", "semantics" and "map"; None for
        metrics that are not available. Groups of views are "mapped"; "unseen", the held-out frames
        at their tracked poses and the views of `unseen` at ground-truth poses transformed into the
        map; and "unseen_refined", the same views with each pose refined on the final map.

    Raises:
        DatasetError: a frame cannot be read, or no estimated pose can be associated with the
            ground truth.
    """
    options = options or MeasureOptions()
    estimate = Trajectory(
        np.array([frame.timestamp_s for frame in tracked]),
        np.array([frame.T_map_camera for frame in tracked]).reshape(-1, 4, 4),
    )
    truth = dataset.ground_truth
    mapped = [frame for frame in tracked if not frame.held_out]
    held_out = [frame for frame in tracked if frame.held_out]

    qualities: dict[str, list[ViewQuality]] = {"mapped": [], "unseen": [], "unseen_refined": []}
    scores = {group: SemanticScores(options.semantics) for group in qualities}
    alignment = map_alignment(estimate, truth, options.alignment)
    scale = 1.0 if alignment is None else alignment.scale

    def measure(group: str, view: EvaluatedView) -> RenderedView | None:
        if view.frame.ignored is not None and view.frame.ignored.all():
            return None  # nothing can be compared
        features = scores[group].needs_features
        rendered = render_view(scene, view, options.backend_name, features, scale)
        scores[group].add(view.rectified() if features else view.frame, rendered.surface)
        qualities[group].append(_quality(rendered, options.lpips))
        return rendered

    small_views: list[SmallView] = []
    compared = _evenly_spaced(min(len(mapped), options.max_views), MAX_COMPARED_VIEWS)
    for place, view in enumerate(_tracked_views(mapped, tracked, dataset, options.max_views)):
        rendered = measure("mapped", view)
        if rendered is not None and place in compared:
            small_views.append(SmallView.of(rendered, scale, options.uses_depth))
    depth_views: list[DepthView] = []
    tracker = DenseTracker(backend_name=options.backend_name)
    seen = _tracked_views(held_out, tracked, dataset, options.max_views)
    for view in chain(seen, _unseen_views(unseen, alignment, options.max_views)):
        measure("unseen", view)
        if len(depth_views) < min(len(held_out), options.max_views):  # held-out frames come first
            depth_views.append(_depth_view(view, scale))
        measure("unseen_refined", _refined(view, scene, tracker, scale))

    images = {group: image_metrics(views) for group, views in qualities.items()}
    depth = {group: depth_metrics(views) for group, views in qualities.items()}
    return {
        "trajectory": trajectory_metrics(estimate, truth, options.alignment),
        "images": images | {"conventions": IMAGE_CONVENTIONS | _view_conventions(options)},
        "depth": depth | {"convention": _DEPTH_CONVENTION},
        "expected": expected_metrics(small_views, dataset),
        **semantic_metrics(scores, options.semantics),
        "map": {
            "gaussians": len(scene),
            "free_space": free_space_metrics(scene, depth_views),
            **_surface_metrics(scene, options.mesh, alignment),
        },
    }


def open_unseen(kind: str, path: Path, image_size: tuple[int, int] | None = None) -> Dataset | None:
    """Open the additional views of a synthetic room in `unseen/`, None if there are none.

    Args:
        kind, path, image_size: as for the dataset itself.
    """
    folder = path / "unseen"
    if not folder.is_dir():
        return None
    try:
        return open_dataset(kind, folder, image_size)
    except ToolkitError as error:
        # Another dataset may have a folder of this name with different content.
        _log.warning("The views in %s are not evaluated: %s", folder, error)
        return None


def _view_conventions(options: MeasureOptions) -> Metrics:
    most = f"at most {options.max_views} of each group, evenly spaced"
    return {
        "mapped": f"tracked frames that were not held out, {most}",
        "unseen": "held-out frames at their tracked poses, and views of unseen/ at true poses "
        f"carried into the map by the alignment ({options.alignment}), {most}",
        "unseen_refined": "the same views, each pose refined on the final map",
        "exposure": "renders are brought to each view's exposure, a gain and a bias, as tracking "
        "found it, and to its white balance, as the run estimated it",
    }


def _tracked_views(
    frames: Sequence[TrackedFrame],
    tracked: Sequence[TrackedFrame],
    dataset: Dataset,
    max_views: int,
) -> Iterator[EvaluatedView]:
    """The views of some of the tracked frames."""
    chosen = [frames[i] for i in _evenly_spaced(len(frames), max_views)]
    images = prefetched(dataset, [frame.index for frame in chosen])
    places = {frame.index: place for place, frame in enumerate(tracked)}
    for frame, image in zip(chosen, images, strict=True):
        around = tracked[max(places[frame.index] - 1, 0) : places[frame.index] + 2]
        yield EvaluatedView(image, frame.T_map_camera, frame.exposure, _velocity(around))


def _velocity(frames: Sequence[TrackedFrame]) -> NDArray[np.float64] | None:
    """Mean velocity [6] from the first to the last of a few frames in a row, if known."""
    if frames[-1].index - frames[0].index != len(frames) - 1:
        return None
    return steady_velocity([f.T_map_camera for f in frames], [f.timestamp_s for f in frames])


def _unseen_views(
    unseen: Dataset | None, alignment: TrajectoryAlignment | None, max_views: int
) -> Iterator[EvaluatedView]:
    if unseen is None or unseen.ground_truth is None or alignment is None:
        return
    for image in prefetched(unseen, _evenly_spaced(len(unseen), max_views)):
        T_world_camera = unseen.ground_truth.at(image.timestamp_s)
        if T_world_camera is not None:
            T_map_camera = se3.inverse(alignment.T_world_map) @ T_world_camera
            T_map_camera[:3, 3] /= alignment.scale
            yield EvaluatedView(image, T_map_camera)


def _evenly_spaced(count: int, max_count: int) -> list[int]:
    """Return at most `max_count` indices below `count`, including the first and the last."""
    return sorted({round(i) for i in np.linspace(0, count - 1, min(count, max_count))})


def map_alignment(
    estimate: Trajectory, truth: Trajectory | None, kind: AlignmentKind
) -> TrajectoryAlignment | None:
    """Return the transformation from the map to the world, None if it is unknown."""
    if kind == "none":
        return TrajectoryAlignment(np.eye(4))
    if truth is None or len(truth) == 0 or len(estimate) == 0:
        return None
    return absolute_trajectory_error(estimate, truth, kind).alignment


def _surface_metrics(
    scene: GaussianScene, mesh: Path | None, alignment: TrajectoryAlignment | None
) -> Metrics:
    # The thickness of walls is a length: without a scale there is none.
    if mesh is None or alignment is None or alignment.scale != 1.0:
        return {}
    return {"walls": wall_thickness(scene, mesh, alignment.T_world_map).metrics()}


def _depth_view(view: EvaluatedView, scale: float) -> DepthView:
    depth_m = view.rectified().depth_m / np.float32(scale)
    return DepthView.at(view.T_map_camera, DepthImage(view.frame.camera, depth_m))


def _refined(
    view: EvaluatedView, scene: GaussianScene, tracker: DenseTracker, scale: float
) -> EvaluatedView:
    """Refine pose and exposure of a view on the map; return the view unchanged if that fails.

    Args:
        scale: of the map.
    """
    gaussians = scene.visible_from(view.frame.camera, view.T_map_camera)
    # The map's file does not store this flag; evaluate as after loading.
    gaussians = replace(gaussians, centred_colours=False)
    balance = view.exposure.balance
    rgb = IDENTITY.with_balance(balance).apply(view.frame.rgb)
    frame = rectified(replace(view.frame, rgb=rgb), view.velocity)
    frame = replace(frame, depth_m=frame.depth_m / np.float32(scale))
    result = tracker.locate(frame, gaussians, view.T_map_camera)
    if result.lost:
        return view
    exposure = result.exposure.with_balance(balance)
    return replace(view, T_map_camera=result.T_map_camera, exposure=exposure)


def _quality(rendered: RenderedView, lpips: Lpips | None) -> ViewQuality:
    frame = rendered.view.frame
    found = (rendered.colour, rendered.depth_m)
    quality = view_quality(found, (frame.rgb, frame.depth_m), lpips, frame.ignored)
    return replace(quality, psnr_one_gain_db=psnr_db(rendered.one_gain, frame.rgb, frame.ignored))
