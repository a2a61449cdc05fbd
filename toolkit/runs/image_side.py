"""The side of a recording's images that is up: stated, measured by the device, or estimated."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.findings import readable_frames
from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.registration_check import evenly_spaced_frames
from toolkit.errors import DependencyError
from toolkit.geometry.image_sides import ImageSide, nearest_side
from toolkit.runs.settings import RunSettings
from toolkit.semantics.segmenters.geometric.image_side import SideJudgement, judge_side

_log = logging.getLogger(__name__)

_FRAMES = 16


@dataclass(frozen=True)
class FoundSide:
    """The side of the images that is up.

    Attributes:
        side: the side.
        findings: a line if it is in doubt.
    """

    side: ImageSide
    findings: tuple[str, ...] = ()

    def chosen(self, settings: RunSettings) -> RunSettings:
        """Return the settings with this side."""
        return replace(settings, dataset=replace(settings.dataset, up=self.side))


def up_side(options: DatasetOptions) -> ImageSide:
    """Return the side of the options; the top if it is not determined."""
    return "top" if options.up == "auto" else options.up


def find_side(dataset: RecordedDataset, settings: RunSettings, has_depth: bool) -> FoundSide:
    """Find the side of a recording's images that is up.

    Args:
        has_depth: whether the run uses the depth of the recording; otherwise, only the options and
            gravity count, as without Open3D.
    """
    if settings.dataset.up != "auto":
        return FoundSide(settings.dataset.up)
    judgement = _by_gravity(dataset)
    if judgement is None:
        judgement = _by_depth(dataset) if has_depth else SideJudgement("top")
    if judgement.side != "top":
        _log.info(
            "%s: the %s of the images is up; --dataset.up states another side.",
            dataset.name,
            _named(judgement.side),
        )
    # Floors that are labelled determine the vertical.
    if judgement.rival is None or dataset.label_names:
        return FoundSide(judgement.side)
    return FoundSide(judgement.side, (_doubt(judgement.side, judgement.rival),))


def _by_gravity(dataset: RecordedDataset) -> SideJudgement | None:
    up, truth = dataset.recording.up_world, dataset.recording.ground_truth
    if up is None or truth is None or not len(truth):
        return None
    return SideJudgement(nearest_side(up @ truth.T_world_camera[:, :3, :3]))


def _by_depth(dataset: RecordedDataset) -> SideJudgement:
    indices = evenly_spaced_frames(len(dataset), _FRAMES)
    try:
        return judge_side(readable_frames(dataset, indices))
    except DependencyError:  # labels from depth, which need the side, report it
        return SideJudgement("top")


def _doubt(side: ImageSide, rival: ImageSide) -> str:
    return (
        f"the vertical is in doubt: the {_named(side)} of the images is taken as up, but floor and "
        f"walls may also fit the {_named(rival)}; --dataset.up {rival} (or {side}) states it"
    )


def _named(side: ImageSide) -> str:
    return f"{side} side" if side in ("left", "right") else side
