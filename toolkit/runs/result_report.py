"""The report of a run, and the rendered views that it shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.version import __version__
from toolkit.datasets.base import Dataset
from toolkit.io.images import write_rgb
from toolkit.io.visualisation import view_strip
from toolkit.runs.evaluation.images import psnr_db
from toolkit.runs.evaluation.metrics import Metrics
from toolkit.runs.evaluation.report import (
    DelaySeries,
    LevelImage,
    ReportContent,
    ReportFloorPlan,
    ReportView,
)
from toolkit.runs.folder import RunFolder
from toolkit.runs.modes import mode_of
from toolkit.runs.outcome import RunOutcome
from toolkit.runs.report_pictures import (
    level_images,
    loop_pictures,
    report_floor_plan,
    submap_graph,
)
from toolkit.runs.settings import dump_settings
from toolkit.scene.growing.listener import scene_graph_of
from toolkit.semantics.palette import Palette
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.slam.pacing.delays import DelaySummary
from toolkit.splatting.gaussians.scene import GaussianScene
from toolkit.splatting.rendering import RenderOptions, SurfaceView, backend, render_surface

_NUM_VIEWS = 6
_LEGEND_ROWS = 8


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


def render_views(
    outcome: RunOutcome, scene: GaussianScene, dataset: Dataset, folder: RunFolder
) -> list[ReportView]:
    """Render evenly spaced views: images in `renders/`, and the views of the report.

    Args:
        scene: the map as stored.
        dataset: the images that views are compared with.
    """
    result, tracked = outcome.result, outcome.tracked
    final = _FinalMap(scene, result.semantics, result.taxonomy, outcome.settings.backend)
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
        picture = view_strip(colour, depth_m, silhouette, frame.rgb, names=outcome.names)
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


def report_content(
    outcome: RunOutcome,
    metrics: Metrics,
    views: Sequence[ReportView],
    warnings: Sequence[str],
    folder: RunFolder,
) -> ReportContent:
    """Return what the report of a run shows.

    Args:
        metrics: those of the run.
        views: of `render_views`.
        warnings: a line each.
        folder: contains the map and the log of the loops.
    """
    result, dataset, settings = outcome.result, outcome.dataset, outcome.settings
    camera, pace = dataset.camera, outcome.record.pace
    if result.dropped_frames:
        dropped = f"{len(result.dropped_frames)} frames were dropped, see delays.csv"
        warnings = [*warnings, dropped]
    return ReportContent(
        title=dataset.name,
        subtitle=f"{len(dataset)} frames, {camera.width}x{camera.height}, seed {settings.seed}",
        metrics=metrics,
        estimate=result.trajectory,
        truth=dataset.ground_truth,
        alignment=mode_of(settings).alignment,
        views=views,
        stage_times=outcome.record.recorder.stage_times(),
        settings=dump_settings(settings),
        warnings=warnings,
        names=outcome.names,
        machine=f"semsplat {__version__}, torch {torch.__version__}, "
        f"{torch.get_num_threads()} threads",
        delays=None if pace is None else _delay_series(pace),
        floor_plan=_floor_plan(outcome, folder),
        loops=loop_pictures(folder.loops, dataset),
        submaps=submap_graph(result, dataset),
        costs=outcome.record.costs,
        states=outcome.states,
    )


def _floor_plan(outcome: RunOutcome, folder: RunFolder) -> ReportFloorPlan | None:
    """The map from above; None without labels, Gaussians or a floor."""
    result = outcome.result
    if result.taxonomy is None or not len(result.map):
        return None
    cameras_m = result.trajectory.positions_m
    graph = scene_graph_of(result)
    return report_floor_plan(folder.map, result.taxonomy, cameras_m, outcome.names, graph)


def _delay_series(pace: DelaySummary) -> DelaySeries:
    return DelaySeries(
        arrival_s=[row.arrival_s for row in pace.delays],
        delay_s=[float("nan") if row.delay_s is None else row.delay_s for row in pace.delays],
        max_delay_s=pace.max_delay_s,
    )
