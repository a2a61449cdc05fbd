"""Evaluate a run against the ground truth and the images of its dataset."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from toolkit.datasets.base import Dataset
from toolkit.evaluation.lpips import Lpips
from toolkit.evaluation.metrics import Metrics
from toolkit.evaluation.options import EvaluationOptions
from toolkit.evaluation.run_metrics import MeasureOptions, TrackedFrame, measure_run, open_unseen
from toolkit.evaluation.semantic_views import SemanticEvaluation
from toolkit.evaluation.trajectory import AlignmentKind
from toolkit.gaussians.scene import GaussianScene, InMemoryScene
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.runs.finished import FinishedRun
from toolkit.runs.settings import RunSettings
from toolkit.semantics.taxonomy import Taxonomy


def evaluate(
    run: FinishedRun,
    dataset_path: str | os.PathLike[str] | None = None,
    max_views: int = MeasureOptions.max_views,
    evaluation: EvaluationOptions | None = None,
) -> Metrics:
    """Evaluate a finished run.

    Args:
        run: result of `load_run`.
        dataset_path: folder of the dataset, if it was moved after the run.
        max_views: maximum number of evaluated views in each group (mapped, held out, unseen),
            >= 1.
        evaluation: optional metrics to compute; by default those of the run.

    Returns:
        Metrics by name, with the unit in the name; None for metrics that are not available. Times
        and memory are not included: they are measured while the run executes.

    Raises:
        ToolkitError: the dataset or the weights of LPIPS cannot be read, or no pose can be
            associated with the ground truth.
    """
    dataset = run.open_dataset(dataset_path)
    path = Path(dataset_path) if dataset_path else run.dataset_path
    location = replace(run.settings.dataset, path=path)
    evaluation = evaluation or run.settings.evaluation
    settings = replace(run.settings, dataset=location, evaluation=evaluation)
    semantics = semantic_evaluation(run.semantics, run.taxonomy, dataset, evaluation.subset)
    scene = InMemoryScene(run.gaussians)
    metrics = evaluate_scene(scene, run.tracked, dataset, settings, semantics, max_views)
    return metrics | {
        "frames": len(run.tracked) + len(run.lost),
        "frames_lost": len(run.lost),
        "keyframes": len(run.keyframes),
        "gaussians": len(run.gaussians),
    }


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
        scene, tracked, dataset: as in `measure_run`.
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
    mesh = path / "mesh.ply" if path and settings.dataset.kind == "synthetic" else None
    if mesh is not None and not mesh.is_file():
        mesh = None
    lpips = load_lpips(settings)
    options = MeasureOptions(
        settings.backend, alignment_kind(settings), max_views, semantics, mesh, lpips
    )
    return measure_run(scene, tracked, dataset, unseen, options)


def load_lpips(settings: RunSettings) -> Lpips | None:
    """Load the network of LPIPS, None if no weights are given.

    Raises:
        DependencyError: a .safetensors file is given and safetensors is not installed.
        FormatError: the weights cannot be read or are not those of LPIPS.
    """
    weights = settings.evaluation.lpips_weights
    return Lpips.load(weights) if weights else None


def alignment_kind(settings: RunSettings) -> AlignmentKind:
    """Return how a run's trajectory is aligned.

    Maps from given poses need no alignment. Without depth, the scale is unknown.
    """
    if settings.poses == "given":
        return "none"
    return "sim3" if settings.depth == "none" else "se3"
