"""Evaluate a run against the ground truth and the images of its dataset."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from toolkit.base.errors import FormatError
from toolkit.datasets.base import Dataset
from toolkit.runs.building import build_frame_sources
from toolkit.runs.evaluation.frame_states import frame_metrics
from toolkit.runs.evaluation.loops import LoopTruthOptions
from toolkit.runs.evaluation.lpips import Lpips
from toolkit.runs.evaluation.meshes import Views, mesh_quality
from toolkit.runs.evaluation.metrics import Metrics
from toolkit.runs.evaluation.options import EvaluationOptions
from toolkit.runs.evaluation.run_loops import run_loop_metrics
from toolkit.runs.evaluation.run_metrics import (
    MeasureOptions,
    TrackedFrame,
    map_alignment,
    measure_run,
    open_unseen,
)
from toolkit.runs.evaluation.semantic_views import SemanticEvaluation
from toolkit.runs.maps.finished import FinishedRun
from toolkit.runs.maps.meshing import MeshOptions, surface_mesh
from toolkit.runs.maps.separate_parts import separate_part_metrics
from toolkit.runs.modes import mode_of
from toolkit.runs.settings import RunSettings
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.frame_preparation import FrameSources
from toolkit.slam.ignored_frames import FramesWithoutIgnored
from toolkit.slam.loops.log import read_loop_log
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.splatting.gaussians.scene import GaussianScene, InMemoryScene

_log = logging.getLogger(__name__)

# The mesh that is compared with the true one: voxels in metres, maximum depth in metres, and the
# maximum number of fused views.
_MESH_VOXEL_M, _MESH_DEPTH_M, _MESH_VIEWS = 0.01, 6.0, 100


def evaluate(
    run: FinishedRun,
    dataset_path: str | os.PathLike[str] | None = None,
    max_views: int = MeasureOptions.max_views,
    evaluation: EvaluationOptions | None = None,
    mesh: Path | None = None,
) -> Metrics:
    """Evaluate a finished run: its main part, and the trajectories of separate parts.

    Args:
        run: result of `load_run`.
        dataset_path: folder of the dataset, if it was moved after the run.
        max_views: maximum number of evaluated views in each group (mapped, held out, unseen),
            >= 1.
        evaluation: optional metrics to compute; by default those of the run.
        mesh: file of the ground-truth mesh in the frame of the ground-truth poses; by default that
            of a synthetic room. Without one, there are no metrics of the mesh.

    Returns:
        Groups of metrics by subject, with units in the keys; None for metrics that are not
        available. Times and memory are not included: they are measured while the run executes.

    Raises:
        ToolkitError: the dataset or the weights of LPIPS cannot be read, or no pose can be
            associated with the ground truth.
    """
    dataset = run.open_dataset(dataset_path)
    path = Path(dataset_path) if dataset_path else run.dataset_path
    location = replace(run.settings.dataset, path=path)
    evaluation = evaluation or run.settings.evaluation
    settings = replace(run.settings, dataset=location, evaluation=evaluation)
    if run.taxonomy is None and run.folder.taxonomy.is_file():
        _log.warning(
            "%s is missing: labels are not evaluated; restore the folder, or run again",
            run.folder.semantics,
        )
    semantics = semantic_evaluation(run.semantics, run.taxonomy, dataset, evaluation.subset)
    scene = InMemoryScene(run.gaussians)
    compared = compared_frames(dataset, settings)
    metrics = evaluate_scene(scene, run.tracked, compared, settings, semantics, max_views)
    metrics["frames"] = frame_metrics(run.states, run.parts, len(run.keyframes))
    separate = separate_part_metrics(
        run.separate_trajectories(), dataset.ground_truth, mode_of(settings).alignment
    )
    metrics["parts"] = {"count": len(run.parts), **separate}
    loops = evaluate_loops(run.folder.loops, dataset, settings)
    return metrics | loops | _mesh_metrics(run, dataset, settings, mesh)


def _mesh_metrics(
    run: FinishedRun, dataset: Dataset, settings: RunSettings, mesh: Path | None
) -> Metrics:
    """The group "mesh": a mesh fused from renders, compared with the true one, if there is one."""
    truth = mesh or true_mesh(settings)
    kind = mode_of(settings).alignment
    alignment = map_alignment(run.trajectory, dataset.ground_truth, kind)
    if truth is None or alignment is None:
        return {}
    every = max(1, math.ceil(len(run.tracked) / _MESH_VIEWS))
    options = MeshOptions(_MESH_VOXEL_M, _MESH_DEPTH_M / alignment.scale, every)
    surface = surface_mesh(run, run.gaussians, options)
    poses = [frame.T_map_camera for frame in run.tracked[::every]]
    views = Views(run.camera, poses, options.max_depth_m)
    metrics = mesh_quality(surface, truth, alignment, views).metrics(options.voxel_m)
    return {"mesh": metrics} if metrics else {}


def true_mesh(settings: RunSettings) -> Path | None:
    """Return the ground-truth mesh of a synthetic room, None for other datasets."""
    path = settings.dataset.path
    mesh = path / "mesh.ply" if path and settings.dataset.kind == "synthetic" else None
    return mesh if mesh is not None and mesh.is_file() else None


def semantic_evaluation(
    semantics: SemanticMapping, taxonomy: Taxonomy | None, dataset: Dataset, subset: bool = False
) -> SemanticEvaluation | None:
    """Prepare the evaluation of a map's labels, None if the map or the dataset has no labels.

    Args:
        subset: compute the papers' subset mIoU as well.
    """
    names = dataset.label_names
    if taxonomy is None or not names:
        return None
    return SemanticEvaluation(semantics, taxonomy, names, subset)


def compared_frames(
    dataset: Dataset, settings: RunSettings, sources: FrameSources | None = None
) -> Dataset:
    """The frames that views of a map are compared with, without what the run ignores.

    Args:
        sources: of the run, which find it; built from the settings by default.

    Raises:
        ToolkitError: labels or masks of the settings are missing.
    """
    if not settings.semantics.ignore:
        return dataset
    return FramesWithoutIgnored(dataset, sources or build_frame_sources(settings, dataset))


def evaluate_scene(
    scene: GaussianScene,
    tracked: Sequence[TrackedFrame],
    dataset: Dataset,
    settings: RunSettings,
    semantics: SemanticEvaluation | None = None,
    max_views: int = MeasureOptions.max_views,
) -> Metrics:
    """Evaluate the map and trajectory of a run with the options of its settings.

    Args:
        scene, tracked, dataset: as in `measure_run`; see `compared_frames`.
        settings: settings of the run, with the current path of the dataset.
        semantics: evaluation of the map's labels, or None.
        max_views: maximum number of evaluated views in each group.

    Raises:
        DatasetError: a frame cannot be read, or no estimated pose can be associated with the
            ground truth.
        FormatError: the weights of LPIPS cannot be read.
    """
    path = settings.dataset.path
    unseen = open_unseen(settings.dataset.kind, path, settings.image_size) if path else None
    if unseen is not None and isinstance(dataset, FramesWithoutIgnored):
        unseen = dataset.beside(unseen)
    lpips = load_lpips(settings)
    options = MeasureOptions(
        settings.backend,
        mode_of(settings).alignment,
        max_views,
        semantics,
        true_mesh(settings),
        lpips,
        mode_of(settings).needs_depth,
    )
    return measure_run(scene, tracked, dataset, unseen, options)


def evaluate_loops(log: Path, dataset: Dataset, settings: RunSettings) -> Metrics:
    """The group "loops", from the log of a run; empty without loop closure or ground truth.

    Raises:
        DatasetError: a frame cannot be read.
        FormatError: a line of the log is not complete.
    """
    if not log.exists():
        return {}
    candidates = settings.loops.candidates
    options = LoopTruthOptions(
        min_gap_frames=candidates.min_gap_frames, min_gap_m=candidates.min_gap_m
    )
    try:
        metrics = run_loop_metrics(read_loop_log(log), dataset, options, settings.evaluation.truth)
    except KeyError as error:
        raise FormatError(f"{log} has a line without {error}; remove the line") from error
    if mode_of(settings).alignment == "sim3":
        # Without a scale, lengths of edges cannot be compared with the truth.
        metrics.pop("edges", None)
    return {"loops": metrics} if metrics else {}


def load_lpips(settings: RunSettings) -> Lpips | None:
    """Load the network of LPIPS, None if no weights are given.

    Raises:
        DependencyError: a .safetensors file is given and safetensors is not installed.
        FormatError: the weights cannot be read or are not those of LPIPS.
    """
    weights = settings.evaluation.lpips_weights
    return Lpips.load(weights) if weights else None
