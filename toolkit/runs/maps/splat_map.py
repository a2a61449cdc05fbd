"""Start a run in a map of another tool: a file of splats without cameras, labels and scale."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from toolkit.base.errors import DatasetError, SettingsError
from toolkit.base.frame import Frame
from toolkit.base.keyframe import evenly_spaced
from toolkit.datasets.base import Dataset, RecordedDataset
from toolkit.datasets.faults import fault_tolerant
from toolkit.runs.maps.splat_clouds import read_cloud
from toolkit.runs.settings import RunSettings
from toolkit.semantics.features.factory import build_describer
from toolkit.slam.loops.splat_maps.metric_map import MapParts, MetricMap, metric_map
from toolkit.slam.tracking.depth_filter import DepthFilter
from toolkit.slam.tracking.factory import build_tracker
from toolkit.slam.tracking.tracker import LocatingTracker
from toolkit.splatting.rendering import backend

# Largest absolute logit of an opacity: that of 0.999.
_MAX_LOGIT = 7.0
# Maximum number of frames, evenly spaced in the recording, that are looked for in the map.
_TRIED = 24
# Reversed bits of 0 to 7.
_ORDER = (0, 4, 2, 6, 1, 5, 3, 7)


def open_splat_map(file: Path, settings: RunSettings, dataset: Dataset | None) -> MetricMap:
    """Read a splat file, and locate frames of a recording in it to scale it to metres.

    Raises:
        ToolkitError: the file cannot be read, the settings do not work with it, or the recording
            does not match it.
    """
    tracker = build_tracker(settings.tracking, settings.backend)
    _check_settings(file, settings, tracker)
    assert isinstance(tracker, LocatingTracker)
    if not isinstance(dataset, RecordedDataset):
        raise SettingsError(
            f"--map {file}: the scale of a splat file is determined with a recording; record "
            "first, use semsplat run, and give the folder of that run to --map"
        )
    cloud = read_cloud(file)
    # The opacities of files of 8 bits are 0 and 1, which optimisation could not change.
    limited = cloud.opacity_logits.clamp(-_MAX_LOGIT, _MAX_LOGIT)
    cloud = replace(cloud, opacity_logits=limited)
    describer = build_describer(settings.loops.features)
    parts = MapParts(backend(settings.backend), tracker, describer)
    frames = _frames(dataset, settings)
    found = metric_map(cloud, dataset.camera, frames, parts)
    if found is None:
        raise DatasetError(
            f"the recording {dataset.name} does not match the map {file}: no frames could be "
            "located in it without doubt; check that both show the same place, or run without --map"
        )
    return found


def summary(file: Path, found: MetricMap) -> dict[str, Any]:
    """How a splat file was scaled, for `saved_map.json`: see `MetricMap`."""
    return {
        "file": str(file),
        "metres_per_unit": found.metres_per_unit,
        "relative_spread": found.spread,
        "located_frames": [frame.index for frame in found.frames],
    }


def _check_settings(file: Path, settings: RunSettings, tracker: object) -> None:
    if not isinstance(tracker, LocatingTracker):
        raise SettingsError(
            f"--map {file} needs a tracker that locates frames; set --tracking.kind dense"
        )
    if settings.loops.features.source != "rgb":
        raise SettingsError(
            f"--map {file}: views of a splat file have no labels to compare; set "
            "--loops.features.source rgb"
        )


def _frames(dataset: RecordedDataset, settings: RunSettings) -> Iterator[Frame]:
    """Frames in the order in which they are tried, the first one first, as they are tracked."""
    depth_filter = DepthFilter() if settings.denoise else None
    for index in _far_apart(evenly_spaced(range(len(dataset)), _TRIED)):
        frame = fault_tolerant(dataset)[index]
        if not frame.fault:
            yield frame if depth_filter is None else depth_filter.of(frame, measured=True)


def _far_apart(indices: list[int]) -> list[int]:
    """The same in an order in which neighbours follow late: every eighth, then those between."""
    places = sorted(range(len(indices)), key=lambda place: (_ORDER[place % len(_ORDER)], place))
    return [indices[place] for place in places]
