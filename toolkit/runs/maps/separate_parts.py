"""Export and evaluate the parts of a map whose position relative to the main part is unknown."""

from __future__ import annotations

from collections.abc import Mapping

from toolkit.base.errors import DatasetError
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.runs.evaluation.metrics import Metrics
from toolkit.runs.evaluation.trajectory import AlignmentKind, absolute_trajectory_error
from toolkit.runs.folder import RunFolder
from toolkit.runs.maps.map_files import labelled_parts
from toolkit.runs.settings import RunSettings
from toolkit.slam.refinement.fusion import FusedMap
from toolkit.slam.result import SlamResult
from toolkit.splatting.gaussians.scene import GaussianScene, HalfPrecisionScene

# Fewer poses can be aligned with any others.
_MIN_POSES = 3


def write_separate_parts(result: SlamResult, folder: RunFolder, settings: RunSettings) -> None:
    """Write trajectory and map of each separate part to `parts/N`, in the frame of the part."""
    for part in result.other_parts:
        target = folder.part(result.parts.index(part.submaps))
        target.path.mkdir(parents=True, exist_ok=True)
        target.write_trajectory(part.frames.trajectory, part.frames.covariances)
        if result.taxonomy is not None:
            result.taxonomy.save(target.taxonomy)  # names the labels of the map for viewers
        if part.map is not None:
            target.write_map(
                labelled_parts(_as_stored(part.map, result), part.map, result, settings)
            )


def _as_stored(fused: FusedMap, result: SlamResult) -> GaussianScene:
    return fused if result.taxonomy is None else HalfPrecisionScene(fused)


def separate_part_metrics(
    trajectories: Mapping[int, Trajectory], truth: Trajectory | None, alignment: AlignmentKind
) -> Metrics:
    """Evaluate each separate part by itself, aligned with the ground truth.

    Args:
        trajectories: poses by number of the part.

    Returns:
        Number of frames and ATE of each part; the ATE is None without ground truth, and for parts
        of fewer than three frames.
    """
    metrics: Metrics = {}
    for number, trajectory in trajectories.items():
        ate_cm = None
        if truth is not None and len(truth) and len(trajectory) >= _MIN_POSES:
            try:
                ate_cm = 100.0 * absolute_trajectory_error(trajectory, truth, alignment).rmse_m
            except DatasetError:
                ate_cm = None  # no pose of the part has ground truth
        metrics[f"part_{number}"] = {"frames": len(trajectory), "ate_rmse_cm": ate_cm}
    return metrics
