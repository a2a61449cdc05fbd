"""Write the results of a run: trajectory, map, rendered views, metrics and report."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from toolkit.base.stages import Stage
from toolkit.base.version import __version__
from toolkit.datasets.base import Dataset, RecordedDataset
from toolkit.datasets.estimates import RecordingEstimates
from toolkit.depth.monocular.motion import CameraMotion
from toolkit.io.atomic import write_bytes, write_text
from toolkit.io.graphs import graph_bytes
from toolkit.runs.evaluation.expected_quality import shortfall_warnings
from toolkit.runs.evaluation.frame_states import frame_metrics, summary_lines
from toolkit.runs.evaluation.metrics import (
    Metrics,
    ate_warnings,
    cost_metrics,
    truth_lines,
    write_metrics,
)
from toolkit.runs.evaluation.report import write_report
from toolkit.runs.folder import RunFolder
from toolkit.runs.formats import RUN_FORMAT
from toolkit.runs.frame_records import frame_records
from toolkit.runs.image_side import up_side
from toolkit.runs.maps.instance_files import write_instances
from toolkit.runs.maps.map_files import labelled_parts
from toolkit.runs.maps.separate_parts import separate_part_metrics, write_separate_parts
from toolkit.runs.modes import mode_of
from toolkit.runs.outcome import RunOutcome, RunRecord
from toolkit.runs.recording_samples import recording_samples
from toolkit.runs.result_report import render_views, report_content
from toolkit.runs.scoring import (
    compared_frames,
    evaluate_loops,
    evaluate_scene,
    semantic_evaluation,
)
from toolkit.runs.settings import RunSettings
from toolkit.scene.graph.node_link import in_frame
from toolkit.scene.growing.listener import scene_graph_of
from toolkit.scene.instances.listener import instances_of
from toolkit.scene.query import FLOOR_NAMES
from toolkit.slam.mapping.consensus import LabelAgreement
from toolkit.slam.result import SlamResult
from toolkit.splatting.gaussians.scene import GaussianScene, HalfPrecisionScene

_log = logging.getLogger(__name__)


def write_results(
    result: SlamResult,
    dataset: Dataset,
    folder: RunFolder,
    settings: RunSettings,
    record: RunRecord,
) -> None:
    """Write trajectory, map, rendered views, metrics and report of a finished run."""
    outcome = RunOutcome.of(result, dataset, settings, record)
    scene = _write_map(outcome, folder)
    _write_frames(outcome, folder)
    # Measured before the evaluation, whose memory does not count.
    metrics = cost_metrics(outcome.costs(len(scene)))

    _log.info("Evaluating the run.")
    compared = compared_frames(dataset, settings, record.sources)
    metrics |= _evaluated(outcome, scene, compared, folder)
    write_metrics(folder.metrics, metrics)

    warnings = _warnings(outcome, metrics)
    views = render_views(outcome, scene, compared, folder)
    write_report(folder.report, report_content(outcome, metrics, views, warnings, folder))
    for line in warnings:
        _log.warning("%s", line)
    _log.info("Wrote the results to %s; see report.html there.", folder.path)


def _write_map(outcome: RunOutcome, folder: RunFolder) -> GaussianScene:
    """Write the map with its labels and objects, and the separate parts.

    Returns:
        The map as stored: the file contains rounded features.
    """
    result, settings = outcome.result, outcome.settings
    scene: GaussianScene = result.map
    if result.taxonomy is not None:
        features = np.concatenate([part.features.half().numpy() for part in scene.parts()])
        folder.write_semantics(features, result.semantics.state(), result.taxonomy)
        scene = HalfPrecisionScene(scene)
    folder.write_map(labelled_parts(scene, result.map, result, settings))
    instances = instances_of(result)
    if instances is not None:
        write_instances(instances, folder, result.taxonomy)
    write_separate_parts(result, folder, settings)
    return scene


def _write_frames(outcome: RunOutcome, folder: RunFolder) -> None:
    """Write poses, states and delays of the frames, and the graph of a growing scene."""
    result, dataset, pace = outcome.result, outcome.dataset, outcome.record.pace
    folder.write_trajectory(result.trajectory, result.covariances)
    metric, origins = outcome.names.metric, _origins(outcome, folder)
    if outcome.settings.scene.graph:
        write_scene_graph(folder, scene_graph_of(result), metric, origins)
    frames = frame_records(result, outcome.tracked, outcome.states, outcome.parts)
    frames |= {"format": RUN_FORMAT, "version": __version__}
    frames |= {"camera": asdict(dataset.camera), "metric": metric, **origins}
    if isinstance(dataset, RecordedDataset):
        frames["recording"] = RecordingEstimates.of(dataset.recording).to_json()
    frames["samples"] = recording_samples(dataset, [frame.index for frame in outcome.tracked])
    if pace is not None:
        frames["dropped"] = result.dropped_frames
        write_text(folder.delays, pace.csv())
    folder.write_json(folder.frames, frames)


def _evaluated(
    outcome: RunOutcome, scene: GaussianScene, compared: Dataset, folder: RunFolder
) -> Metrics:
    """The metrics of a run, without those of time and memory.

    Args:
        scene: the map as stored.
        compared: the images that views are compared with.
    """
    result, dataset, settings = outcome.result, outcome.dataset, outcome.settings
    subset = settings.evaluation.subset
    semantics = semantic_evaluation(result.semantics, result.taxonomy, dataset, subset)
    metrics = evaluate_scene(scene, outcome.tracked, compared, settings, semantics)
    metrics["frames"] = frame_metrics(outcome.states, outcome.parts, len(result.keyframe_indices))
    separate = {result.parts.index(p.submaps): p.frames.trajectory for p in result.other_parts}
    apart = separate_part_metrics(separate, dataset.ground_truth, mode_of(settings).alignment)
    metrics["parts"] = {"count": len(outcome.parts), **apart}
    metrics |= evaluate_loops(folder.loops, dataset, settings)
    return metrics | _mode_metrics(outcome.record) | _label_metrics(result.label_agreement)


def _warnings(outcome: RunOutcome, metrics: Metrics) -> list[str]:
    """What the user should know about the result, a line each."""
    record, is_dense = outcome.record, outcome.settings.tracking.kind == "dense"
    return [
        *(*record.findings, *summary_lines(outcome.states, outcome.parts), *ate_warnings(metrics)),
        *truth_lines(metrics["trajectory"]),
        *(*outcome.result.label_agreement.findings, *outcome.names.notes),
        *_motion_doubts(record),
        *shortfall_warnings(metrics, bool(record.findings), not is_dense),
    ]


def write_scene_graph(
    folder: RunFolder, content: dict[str, Any] | None, metric: bool, origins: Mapping[str, Any]
) -> None:
    """Write the graph of a growing scene as JSON, JSON-LD and GraphML; log if there is none.

    Args:
        folder: the run folder.
        content: the graph without its frame; None if no floor was found.
        metric: whether the unit of length is the metre.
        origins: may contain `origin_m`, the map's origin in the coordinates of given poses.

    Raises:
        RunFolderError: a file cannot be written.
    """
    if content is None:
        _log.warning(
            "No scene graph was written, because no floor was found: no surface of the classes %s "
            "forms a plane.",
            ", ".join(FLOOR_NAMES),
        )
        return
    content = in_frame(content, metric, origins.get("origin_m", [0.0, 0.0, 0.0]))
    for suffix in (".json", ".jsonld", ".graphml"):
        write_bytes(folder.scene_graph.with_suffix(suffix), graph_bytes(content, suffix))


def _origins(outcome: RunOutcome, folder: RunFolder) -> dict[str, Any]:
    """Where the frames are from, which side is up, and what given poses are relative to."""
    settings = outcome.settings
    origins: dict[str, Any] = {"up": up_side(settings.dataset)}
    origin_m = mode_of(settings).origin_m(outcome.dataset)
    if origin_m is not None:
        origins["origin_m"] = origin_m.tolist()
    if settings.dataset.path is not None:
        origins["dataset_from_run"] = os.path.relpath(settings.dataset.path, folder.path)
    return origins


def _mode_metrics(record: RunRecord) -> Metrics:
    """Groups of metrics that only runs in real time, without depth or with depth priors have."""
    metrics: Metrics = {} if record.pace is None else record.pace.metrics()
    motion = record.motion
    if motion is not None:
        motion_ms = record.recorder.total_ms(Stage.MOTION) or 0.0
        per_frame = {"motion_ms_per_frame": motion_ms / motion.frames}
        metrics["monocular"] = motion.metrics() | per_frame
    if record.prior is not None:
        metrics["depth_prior"] = record.prior.metrics()
    return metrics


def _motion_doubts(record: RunRecord) -> list[str]:
    """What makes the motion of a run without depth unreliable, a line each."""
    doubts = [] if record.motion is None else record.motion.doubts
    return [f"The result is not reliable: {doubt}." for doubt in doubts]


def _label_metrics(agreement: LabelAgreement) -> Metrics:
    """The group "labels", of runs whose keyframes vote for the labels of the map."""
    share = agreement.changed_share
    if share is None:
        return {}
    _log.info("The votes of keyframes changed %.1f %% of their labelled pixels.", 100.0 * share)
    convention = "of the labelled pixels of surfaces that at least three keyframes show"
    return {"labels": {"changed_by_votes_percent": 100.0 * share, "convention": convention}}


def write_motion_alone(motion: CameraMotion, folder: RunFolder) -> None:
    """Write the metrics of a run without a map, because its motion could not be determined."""
    frames = {"total": motion.frames, "lost": motion.frames - len(motion.trajectory)}
    write_metrics(folder.metrics, {"frames": frames, "monocular": motion.metrics()})
    _log.warning("There is no map; see %s.", folder.metrics)
