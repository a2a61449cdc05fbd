"""The floor plan of a run for its report."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.evaluation.report import ReportFloorPlan
from toolkit.io.length_names import LengthNames
from toolkit.io.splats import read_splats
from toolkit.semantics.floor_plan import draw_floor_plan, floor_plan
from toolkit.semantics.palette import Palette
from toolkit.semantics.query import LabelledMap
from toolkit.semantics.taxonomy import Taxonomy

# Gaussians with a smaller opacity do not represent surfaces.
_MIN_OPACITY = 0.5


def report_floor_plan(
    file: Path, taxonomy: Taxonomy, cameras_m: NDArray[np.float64], names: LengthNames
) -> ReportFloorPlan | None:
    """Draw the floor plan of a labelled map.

    Args:
        file: the splats of the map with labels.
        taxonomy: taxonomy of the labels.
        cameras_m: [P, 3] positions of the camera in the frame of the map.
        names: of lengths.

    Returns:
        The floor plan, None if the map has no labels or no floor was found.
    """
    splats = read_splats(file)
    opaque = splats.opacity_logits >= np.log(_MIN_OPACITY / (1 - _MIN_OPACITY))
    if splats.labels is None or not opaque.any():
        return None
    means_m = splats.means[opaque].astype(np.float64)
    labelled = LabelledMap(means_m, splats.labels.select(opaque), taxonomy)
    ground = labelled.ground()
    if ground is None:
        return None
    palette = Palette(taxonomy)
    radii_m = np.exp(splats.log_radii[opaque]).astype(np.float64)
    plan = floor_plan(labelled, radii_m, ground, cameras_m, palette)
    return ReportFloorPlan(draw_floor_plan(plan, palette, legend=False, names=names), plan.areas)
