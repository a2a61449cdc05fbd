"""Write the results of a run: trajectory, map, rendered views, metrics and report."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit import __version__
from toolkit.datasets.base import Dataset
from toolkit.evaluation.expected_quality import shortfall_warnings
from toolkit.evaluation.frame_costs import FrameCosts, gaussian_bytes, peak_memory_mb
from toolkit.evaluation.frame_states import (
    frame_metrics,
    frame_states,
    part_summaries,
    summary_lines,
)
from toolkit.evaluation.images import psnr_db
from toolkit.evaluation.metrics import (
    Metrics,
    RunCosts,
    ate_warnings,
    cost_metrics,
    truth_lines,
    write_metrics,
)
from toolkit.evaluation.report import (
    DelaySeries,
    LevelImage,
    ReportContent,
    ReportView,
    write_report,
)
from toolkit.evaluation.run_metrics import TrackedFrame
from toolkit.evaluation.timing import StageRecorder
from toolkit.gaussians.scene import GaussianScene, HalfPrecisionScene
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera
from toolkit.io.atomic import write_bytes, write_text
from toolkit.io.graphs import graph_bytes
from toolkit.io.images import write_rgb
from toolkit.io.length_names import LengthNames
from toolkit.io.visualisation import view_strip
from toolkit.mapping.consensus import LabelAgreement
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.monocular.motion import CameraMotion
from toolkit.pacing.delays import DelaySummary
from toolkit.rendering import RenderOptions, SurfaceView, backend, render_surface
from toolkit.runs.depth_prior_use import DepthPriorUse
from toolkit.runs.evaluation import (
    compared_frames,
    evaluate_loops,
    evaluate_scene,
    semantic_evaluation,
)
from toolkit.runs.folder import RunFolder
from toolkit.runs.frame_records import frame_records
from toolkit.runs.image_side import up_side
from toolkit.runs.instance_files import write_instances
from toolkit.runs.map_files import labelled_parts
from toolkit.runs.modes import mode_of
from toolkit.runs.recording_samples import recording_samples
from toolkit.runs.report_pictures import (
    level_images,
    loop_pictures,
    report_floor_plan,
    submap_graph,
)
from toolkit.runs.separate_parts import separate_part_metrics, write_separate_parts
from toolkit.runs.settings import RunSettings, dump_settings
from toolkit.semantics.palette import Palette
from toolkit.semantics.query import FLOOR_NAMES
from toolkit.semantics.storey_rooms import graph_frame
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.frame_preparation import FrameSources
from toolkit.slam.result import SlamResult
from toolkit.stages import Stage

_log = logging.getLogger(__name__)

_NUM_VIEWS = 6
_LEGEND_ROWS = 8


def held_out(index: int, settings: RunSettings) -> bool:
    """Return whether a frame is excluded from mapping.

    It is the last of every n frames, because the first frame must start the map.
    """
    return settings.hold_out is not None and index % settings.hold_out == settings.hold_out - 1


@dataclass(frozen=True)
class RunRecord:
    """How a run came about.

    Attributes:
        recorder: times of its stages.
        costs: time and memory by frame.
        pace: delays of a run in real time, None for other runs.
        motion: motion of the camera that a run without depth starts from, None for other runs.
        prior: depth priors of the run, None without them.
        findings: a line for each defect of the recording that a few of its frames show.
        sources: find what is ignored in a frame; built again from the settings if None.
    """

    recorder: StageRecorder
    costs: FrameCosts
    pace: DelaySummary | None = None
    motion: CameraMotion | None = None
    prior: DepthPriorUse | None = None
    findings: tuple[str, ...] = ()
    sources: FrameSources | None = None


def write_results(
    result: SlamResult,
    dataset: Dataset,
    folder: RunFolder,
    settings: RunSettings,
    record: RunRecord,
) -> None:
    """Write trajectory, map, rendered views, metrics and report of a finished run."""
    recorder, pace = record.recorder, record.pace
    scene: GaussianScene = result.map
    if result.taxonomy is not None:
        features = np.concatenate([part.features.half().numpy() for part in scene.parts()])
        folder.write_semantics(features, result.semantics.state(), result.taxonomy)
        # Evaluate the map as stored: the file contains rounded features.
        scene = HalfPrecisionScene(scene)
    tracked = tracked_frames(result, settings)
    folder.write_trajectory(result.trajectory, result.covariances)
    folder.write_map(labelled_parts(scene, result.map, result, settings))
    if result.instances is not None:
        write_instances(result.instances, folder, result.taxonomy)
    names, origins = LengthNames(_is_metric(record)), _origins(dataset, folder, settings)
    if settings.scene.graph:
        write_scene_graph(folder, result.scene_graph, names.metric, origins)
    write_separate_parts(result, folder, settings)
    states, parts = frame_states(result), part_summaries(result)
    frames = frame_records(result, tracked, states, parts)
    frames |= {"camera": asdict(dataset.camera), "metric": names.metric, **origins}
    frames["samples"] = recording_samples(dataset, [frame.index for frame in tracked])
    if pace is not None:
        frames["dropped"] = result.dropped_frames
        write_text(folder.delays, pace.csv())
    folder.write_json(folder.frames, frames)
    # Measured before the evaluation, whose memory does not count.
    costs = _costs(result, scene, dataset, record)
    _log.info("Evaluating the run.")
    compared = compared_frames(dataset, settings, record.sources)
    semantics = semantic_evaluation(
        result.semantics, result.taxonomy, dataset, settings.evaluation.subset
    )
    metrics = cost_metrics(costs) | evaluate_scene(scene, tracked, compared, settings, semantics)
    metrics["frames"] = frame_metrics(states, parts, len(result.keyframe_indices))
    separate = {result.parts.index(p.submaps): p.frames.trajectory for p in result.other_parts}
    apart = separate_part_metrics(separate, dataset.ground_truth, mode_of(settings).alignment)
    metrics["parts"] = {"count": len(parts), **apart}
    metrics |= evaluate_loops(folder.loops, dataset, settings)
    metrics |= _mode_metrics(record) | _label_metrics(result.label_agreement)
    write_metrics(folder.metrics, metrics)
    summary = [
        *(*record.findings, *summary_lines(states, parts), *ate_warnings(metrics)),
        *(*truth_lines(metrics["trajectory"]), *result.label_agreement.findings, *names.notes),
        *_motion_doubts(record),
        *shortfall_warnings(metrics, bool(record.findings), settings.tracking.kind != "dense"),
    ]
    final = _FinalMap(scene, result.semantics, result.taxonomy, settings.backend)
    views = _render_views(final, tracked, compared, folder, names)
    report = _report(result, dataset, settings, metrics, views, recorder)
    if pace is not None:
        report = replace(report, delays=_delay_series(pace))
    if result.taxonomy is not None and len(scene):
        cameras_m = result.trajectory.positions_m
        plan = report_floor_plan(folder.map, result.taxonomy, cameras_m, names, result.scene_graph)
        report = replace(report, floor_plan=plan)
    report = replace(
        report,
        loops=loop_pictures(folder.loops, dataset),
        submaps=submap_graph(result, dataset),
        costs=record.costs,
        states=states,
        warnings=[*summary, *report.warnings],
        names=names,
    )
    write_report(folder.report, report)
    for line in summary:
        _log.warning("%s", line)
    _log.info("Wrote the results to %s; see report.html there.", folder.path)


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
    frame = graph_frame(metric, origins.get("origin_m", [0.0, 0.0, 0.0]))
    content = content | {"graph": frame | content["graph"]}
    for suffix in (".json", ".jsonld", ".graphml"):
        write_bytes(folder.scene_graph.with_suffix(suffix), graph_bytes(content, suffix))


def _is_metric(record: RunRecord) -> bool:
    """Whether the unit of length is the metre."""
    if record.motion is not None:
        return record.motion.metric_scale is not None
    correction = None if record.prior is None else record.prior.correction
    return correction is None or correction.metric


def _origins(dataset: Dataset, folder: RunFolder, settings: RunSettings) -> dict[str, Any]:
    """Where the frames are from, which side is up, and what given poses are relative to."""
    origins: dict[str, Any] = {"up": up_side(settings.dataset)}
    origin_m = mode_of(settings).origin_m(dataset)
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


def tracked_frames(result: SlamResult, settings: RunSettings) -> list[TrackedFrame]:
    """Return all frames with a pose, in the form used by the evaluation."""
    trajectory = result.trajectory
    return [
        TrackedFrame(index, float(time), T, exposure, held_out(index, settings))
        for index, time, T, exposure in zip(
            result.frame_indices,
            trajectory.timestamps_s,
            trajectory.T_world_camera,
            result.exposures,
            strict=True,
        )
    ]


def _costs(
    result: SlamResult, scene: GaussianScene, dataset: Dataset, record: RunRecord
) -> RunCosts:
    count, recorder = len(scene), record.recorder
    return RunCosts(
        frames=len(dataset),
        columns_ms={column: float(ms.sum()) for column, ms in record.costs.columns_ms.items()},
        refinement_ms=recorder.total_ms(Stage.REFINEMENT),
        online_ms=recorder.total_ms(Stage.ONLINE),
        total_ms=recorder.total_ms(Stage.MOTION, Stage.ONLINE, Stage.FINISH),
        peak_memory_mb=peak_memory_mb(),
        map_mb=count * gaussian_bytes(result.semantics.channels) / 1e6,
    )


@dataclass(frozen=True)
class _FinalMap:
    """The final map with the decoder of its features and the renderer."""

    scene: GaussianScene
    semantics: SemanticMapping
    taxonomy: Taxonomy | None
    backend_name: str

    def render(self, camera: Camera, T_map_camera: NDArray[np.float64]) -> SurfaceView:
        """Render a view, with features if the map has semantics."""
        options = RenderOptions(features=self.taxonomy is not None)
        gaussians = self.scene.visible_from(camera, T_map_camera)
        T_camera_map = se3.inverse(T_map_camera)
        return render_surface(backend(self.backend_name), gaussians, camera, T_camera_map, options)


def _render_views(
    final: _FinalMap,
    tracked: list[TrackedFrame],
    dataset: Dataset,
    folder: RunFolder,
    names: LengthNames,
) -> list[ReportView]:
    """Render evenly spaced views: images in `renders/`, and the views of the report."""
    views = []
    # A user may have removed the folder of an interrupted run.
    folder.renders.mkdir(exist_ok=True)
    palette = None if final.taxonomy is None else Palette(final.taxonomy)
    count = min(_NUM_VIEWS, len(tracked))
    for position in np.linspace(0, len(tracked) - 1, count).round().astype(int):
        view = tracked[position]
        frame = dataset[view.index]
        rendered = final.render(frame.camera, view.T_map_camera)
        colour = view.exposure.undo(rendered.output.colour).clamp(0.0, 1.0).numpy()
        depth_m, silhouette = rendered.depth_m.numpy(), rendered.output.silhouette.numpy()
        name = f"frame{view.index:06d}"
        write_rgb(folder.renders / f"{name}.png", colour)
        picture = view_strip(colour, depth_m, silhouette, frame.rgb, names=names)
        write_rgb(folder.renders / f"{name}_strip.png", picture.astype(np.float32) / 255.0)
        levels: list[LevelImage] = []
        if palette is not None:
            nodes = final.semantics.decode_view(rendered).nodes.T.reshape(-1, *depth_m.shape)
            levels = level_images(palette, list(nodes))
            picture = palette.level_strip(colour, list(nodes), legend_rows=_LEGEND_ROWS)
            write_rgb(folder.renders / f"{name}_levels.png", picture.astype(np.float32) / 255.0)
        title = f"frame {view.index}" + (", unseen" if view.held_out else "")
        score = psnr_db(colour, frame.rgb, frame.ignored)
        views.append(ReportView(title, frame.rgb, colour, frame.depth_m, depth_m, score, levels))
    return views


def _report(
    result: SlamResult,
    dataset: Dataset,
    settings: RunSettings,
    metrics: Metrics,
    views: list[ReportView],
    recorder: StageRecorder,
) -> ReportContent:
    camera = dataset.camera
    warnings = []
    if result.dropped_frames:
        warnings.append(f"{len(result.dropped_frames)} frames were dropped, see delays.csv")
    return ReportContent(
        title=dataset.name,
        subtitle=f"{len(dataset)} frames, {camera.width}x{camera.height}, seed {settings.seed}",
        metrics=metrics,
        estimate=result.trajectory,
        truth=dataset.ground_truth,
        alignment=mode_of(settings).alignment,
        views=views,
        stage_times=recorder.stage_times(),
        settings=dump_settings(settings),
        warnings=warnings,
        machine=f"semsplat {__version__}, torch {torch.__version__}, "
        f"{torch.get_num_threads()} threads",
    )


def _delay_series(pace: DelaySummary) -> DelaySeries:
    return DelaySeries(
        arrival_s=[row.arrival_s for row in pace.delays],
        delay_s=[float("nan") if row.delay_s is None else row.delay_s for row in pace.delays],
        max_delay_s=pace.max_delay_s,
    )
