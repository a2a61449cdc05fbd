"""Evaluate a run against the ground truth and the images of its dataset."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from toolkit.datasets.base import Dataset
from toolkit.evaluation.lpips import Lpips
from toolkit.evaluation.metrics import Metrics
from toolkit.evaluation.options import EvaluationOptions
from toolkit.evaluation.run_metrics import MeasureOptions, TrackedFrame, measure_run, open_unseen
from toolkit.evaluation.semantic_views import SemanticReading
from toolkit.gaussians.scene import GaussianScene, WholeScene
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
        run: as `load_run` returns it.
        dataset_path: folder of the dataset, if it has moved since the run.
        max_views: maximum number of views scored in each group (mapped, held out, unseen), >= 1.
        evaluation: which optional metrics are computed; by default those of the run.

    Returns:
        Metrics by name, with the unit in the name; None where a metric does not apply. Times and
        memory are not part of them: they are measured while the run executes.

    Raises:
        ToolkitError: the dataset or the weights of LPIPS cannot be read, or the dataset shares
            no time with the trajectory.
    """
    dataset = run.open_dataset(dataset_path)
    path = Path(dataset_path) if dataset_path else run.dataset_path
    location = replace(run.settings.dataset, path=path)
    evaluation = evaluation or run.settings.evaluation
    settings = replace(run.settings, dataset=location, evaluation=evaluation)
    reading = reading_of(run.semantics, run.taxonomy, dataset, evaluation.subset)
    scene = WholeScene(run.gaussians)
    figures = measured(scene, run.tracked, dataset, settings, reading, max_views)
    return figures | {
        "frames": len(run.tracked) + len(run.lost),
        "frames_lost": len(run.lost),
        "keyframes": len(run.keyframes),
        "gaussians": len(run.gaussians),
    }


def reading_of(
    semantics: SemanticMapping, taxonomy: Taxonomy | None, dataset: Dataset, subset: bool = False
) -> SemanticReading | None:
    """How a map is scored against the data set's labels; None where there is nothing to score.

    Args:
        subset: measure the papers' subset mIoU as well.
    """
    names = dataset.label_names
    if taxonomy is None or not names:
        return None
    return SemanticReading(semantics, taxonomy, names, subset)


def measured(
    scene: GaussianScene,
    tracked: Sequence[TrackedFrame],
    dataset: Dataset,
    settings: RunSettings,
    reading: SemanticReading | None = None,
    max_views: int = MeasureOptions.max_views,
) -> Metrics:
    """A run's figures, measured as its settings ask for.

    Args:
        scene, tracked, dataset: as `measure_run` takes them.
        settings: what the run was made with, with the place of its data set.
        reading: of the map's semantics, or None.
        max_views: most views scored of each group.

    Raises:
        DatasetError: a frame cannot be read, or truth and estimate share no time.
        FormatError: the weights of LPIPS cannot be read.
    """
    path = settings.dataset.path
    unseen = open_unseen(settings.dataset.kind, path, settings.image_size) if path else None
    mesh = path / "mesh.ply" if path and settings.dataset.kind == "synthetic" else None
    if mesh is not None and not mesh.is_file():
        mesh = None
    lpips = lpips_of(settings)
    options = MeasureOptions(
        settings.backend, alignment_of(settings), max_views, reading, mesh, lpips
    )
    return measure_run(scene, tracked, dataset, unseen, options)


def lpips_of(settings: RunSettings) -> Lpips | None:
    """The network of LPIPS, or None where no weights are given.

    Raises:
        DependencyError: a .safetensors file is given and safetensors is missing.
        FormatError: the weights cannot be read or are not those of LPIPS.
    """
    weights = settings.evaluation.lpips_weights
    return Lpips.load(weights) if weights else None


def alignment_of(settings: RunSettings) -> Literal["none", "se3"]:
    """Given poses put the map into the world of the truth; otherwise it has its own."""
    return "none" if settings.poses == "given" else "se3"
