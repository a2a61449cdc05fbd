"""What a right map could reach, from the images alone, and what is wrong with maps far below.

Unlike errors of the trajectory and of labels, this needs no ground truth: whatever was stated about
a recording and is wrong, the map is worse than neighbouring images allow.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from toolkit.base.errors import ToolkitError
from toolkit.base.frame import Frame
from toolkit.datasets.base import Dataset
from toolkit.runs.evaluation.images import MAX_PSNR_DB, mean_or_none
from toolkit.runs.evaluation.neighbouring_images import SIDE_PX, SmallView, ViewComparison, compare

MAX_COMPARED_VIEWS = 10
# Fewer views say little about a map.
_MIN_VIEWS = 4
# Shortfall in dB that is reported, and the part of the views that must exceed it. Right maps of
# synthetic rooms are 13 dB above to 2 dB below neighbouring images, those of real sensors at most
# 2.5 dB below (fast turns, glossy floors), and wrong ones 5 dB and more.
_FAR_BELOW_DB, _EXCEEDING = 4.5, 2.0 / 3.0
# Errors in depth that are reported: relative to those between neighbouring frames, and to the
# depth. Right maps have at most 1.2 times the former, wrong ones 1.7 to 3 times.
_FAR_ABOVE, _LEAST_DEPTH = 1.6, 0.005
# What counts as a sign of a reason: dB that an exposure per view would gain, pixels between map and
# image, share of displaced pixels where most are in place, share of doubtful frames.
_EXPOSURE_DB, _OFFSET_PX, _DISPLACED, _DOUBTFUL = 2.0, 0.25, 0.1, 0.2
# Share of the optimisation steps that a run in real time skipped.
_SKIPPED = 0.3
_MAX_REASONS = 4

_CONVENTION = (
    f"medians over at most {MAX_COMPARED_VIEWS} mapped views, at most {SIDE_PX} pixels wide and "
    "high, over the pixels that the images before and after show; expected: these images, carried "
    "into the view by optical flow; reached: the map; depth errors: mean relative ones, expected "
    "between neighbouring frames after a rigid motion; offset: distance between where the map and "
    "the image show the same, displaced: farther than a pixel; shortfall: exceeded by two thirds "
    "of the views"
)


def expected_metrics(views: Sequence[SmallView], dataset: Dataset) -> dict[str, Any]:
    """The group "expected" of metrics.json; None for what is not known.

    Args:
        views: of mapped frames.
        dataset: their frames and those beside them.
    """
    compared = [found for view in views if (found := _compared(view, dataset)) is not None]
    reached, expected, fitted = (
        np.array([_db(getattr(each, name)) for each in compared])
        for name in ("map_error", "image_error", "fitted_error")
    )
    depth = {name: _median([vars(c)[name] for c in compared]) for name in _DEPTHS}
    return {
        "views": len(compared),
        "reached_db": _median(reached),
        "expected_db": _median(expected),
        "shortfall_db": _quantile(expected - reached, 1.0 - _EXCEEDING),
        "exposure_gain_db": _median(fitted - reached),
        "reached_depth_percent": _percent(depth["map_depth"]),
        "expected_depth_percent": _percent(depth["image_depth"]),
        "offset_px": _median([each.offset_px for each in compared]),
        "displaced_percent": _percent(mean_or_none([each.displaced for each in compared])),
        "convention": _CONVENTION,
    }


_DEPTHS = ("map_depth", "image_depth")


def shortfall_warnings(
    metrics: Mapping[str, Any], reported: bool = False, baseline: bool = False
) -> list[str]:
    """Warn of a map that is far worse than its images allow, with likely reasons in order.

    Args:
        metrics: of a run.
        reported: whether checks of the recording found something, which is reported before.
        baseline: whether the map is that of a baseline.
    """
    found = metrics["expected"]
    if found["views"] < _MIN_VIEWS:
        return []
    comparisons = []
    if found["shortfall_db"] > _FAR_BELOW_DB:
        comparisons.append(
            f"its views match the images at {found['reached_db']:.1f} dB, and neighbouring images "
            f"match each other at {found['expected_db']:.1f} dB"
        )
    reached, expected = (found[f"{name}_depth_percent"] for name in ("reached", "expected"))
    if reached is not None and reached > max(_FAR_ABOVE * expected, 100.0 * _LEAST_DEPTH):
        comparisons.append(
            f"its depth differs from the measured one by {reached:.2f} %, and that of neighbouring "
            f"images by {expected:.2f} %"
        )
    if not comparisons:
        return []
    own = ["the methods of a baseline (tracking.kind)"] if baseline else []
    likely = [*own, *_reasons(metrics, reported)][:_MAX_REASONS]
    advice = "" if reported else "; semsplat check-data examines the recording"
    return [
        f"The map is worse than its images allow: {'; '.join(comparisons)}.",
        f"Likely reasons, in this order: {'; '.join(likely)}{advice}.",
    ]


def _reasons(metrics: Mapping[str, Any], reported: bool) -> Iterator[str]:
    """What may be wrong, the most likely first."""
    found, frames = metrics["expected"], metrics.get("frames", {})
    pace = metrics.get("pace", {})
    skipped = pace.get("mapping_steps_skipped", 0) > _SKIPPED * pace.get("mapping_steps_due", 0)
    if skipped or pace.get("frames_dropped"):
        yield "frames or steps of the optimisation that were skipped (--pace)"
    if reported:
        yield "what the checks of the recording report above"
    if not metrics.get("monocular", {}).get("reliable", True):
        yield "the motion is not reliable (monocular.doubts)"
    doubtful = frames.get("doubtful", 0) + frames.get("lost", 0)
    if doubtful > _DOUBTFUL * frames.get("total", math.inf):
        yield f"{doubtful} of {frames['total']} frames are doubtful or lost"
    if found["exposure_gain_db"] > _EXPOSURE_DB:
        yield f"changes of exposure that are not modelled ({found['exposure_gain_db']:.1f} dB)"
    in_place = found["offset_px"] < _OFFSET_PX
    if in_place and found["displaced_percent"] > 100.0 * _DISPLACED:
        yield "moving or reflecting things"
    if metrics["trajectory"]["alignment"] == "none":
        yield "given poses that are wrong, late or in another unit"
    if "depth_prior" in metrics:
        yield "depth priors that are not what is declared"
    yield "intrinsics or a lens distortion that are not those of the camera"
    if found["expected_depth_percent"] is not None:
        yield "depth that is wrong, or not registered to colour"
    yield "motion blur" if in_place else "moving things"


def _compared(view: SmallView, dataset: Dataset) -> ViewComparison | None:
    return compare(view, _beside(view, dataset))


def _beside(view: SmallView, dataset: Dataset) -> Iterator[Frame]:
    """The frames before and after a view that can be read."""
    for index in (view.index - 1, view.index + 1):
        if not 0 <= index < len(dataset):
            continue
        try:
            frame = dataset[index]
        except ToolkitError:
            continue
        if not frame.fault and frame.camera.size == view.source_size:
            yield frame


def _db(mean_square: float) -> float:
    return -10.0 * math.log10(max(mean_square, 10.0 ** (-MAX_PSNR_DB / 10.0)))


def _median(values: Sequence[float | None] | np.ndarray) -> float | None:
    return _quantile(values, 0.5)


def _quantile(values: Sequence[float | None] | np.ndarray, share: float) -> float | None:
    known = [float(value) for value in values if value is not None]
    return float(np.quantile(known, share)) if known else None


def _percent(value: float | None) -> float | None:
    return None if value is None else 100.0 * value
