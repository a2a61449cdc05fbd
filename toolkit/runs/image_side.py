"""The side of a recording's images that is up: stated, measured by the device, or estimated."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from toolkit.base.errors import DependencyError
from toolkit.base.frame import Frame
from toolkit.base.geometry.image_sides import ImageSide, nearest_side
from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.samples import spread_frames
from toolkit.runs.settings import RunSettings
from toolkit.semantics.segmenters.geometric.image_side import SideJudgement, judge_side
from toolkit.slam.length_unit import LengthUnit


@dataclass(frozen=True)
class FoundSide:
    """The side of the images that is up.

    Attributes:
        side: the side.
        findings: a line if it is in doubt.
        notes: a line if another side than the top was found.
    """

    side: ImageSide
    findings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def chosen(self, settings: RunSettings) -> RunSettings:
        """Return the settings with this side."""
        return replace(settings, dataset=replace(settings.dataset, up=self.side))


def up_side(options: DatasetOptions) -> ImageSide:
    """Return the side of the options; the top if it is not determined."""
    return "top" if options.up == "auto" else options.up


def find_side(
    dataset: RecordedDataset, frames: Iterable[Frame], options: DatasetOptions
) -> FoundSide:
    """Find the side of a recording's images that is up.

    Args:
        frames: evenly spaced ones with depth. Without them, or without Open3D, only the options
            and gravity count.
        options: may state the side.
    """
    if options.up != "auto":
        return FoundSide(options.up)
    judgement = _by_gravity(dataset) or _by_depth(frames)
    side, rival = judgement.side, judgement.rival
    # Labelled floors determine the vertical.
    findings = () if rival is None or dataset.label_names else (_doubt(side, rival),)
    notes = () if side == "top" else (f"the {_named(side)} of the images is up",)
    return FoundSide(side, findings, notes)


def side_seen_afterwards(dataset: RecordedDataset, options: DatasetOptions) -> FoundSide:
    """Find the side that was up in the images of a live camera, when all have been processed.

    Args:
        dataset: the stored images.
        options: those at the start, which may state the side.

    Returns:
        The side, with a finding if it was not the one that the map was labelled by.
    """
    found = find_side(dataset, spread_frames(dataset), options)
    assumed = up_side(options)
    if found.side == assumed:
        return found
    finding = (
        f"the {_named(found.side)} of the images is up, but classes were found as if the "
        f"{_named(assumed)} were; start with --dataset.up {found.side} next time"
    )
    return replace(found, findings=(finding, *found.findings))


def _by_gravity(dataset: RecordedDataset) -> SideJudgement | None:
    up, truth = dataset.recording.up_world, dataset.recording.ground_truth
    if up is None or truth is None or not len(truth):
        return None
    return SideJudgement(nearest_side(up @ truth.T_world_camera[:, :3, :3]))


def _by_depth(frames: Iterable[Frame]) -> SideJudgement:
    frames = [*frames]
    # Sizes of floors and furniture are those of rooms.
    unit = LengthUnit.of_frames(frames)
    try:
        return judge_side(map(unit.frame, frames))
    except DependencyError:  # labels from depth, which need the side, report it
        return SideJudgement("top")


def _doubt(side: ImageSide, rival: ImageSide) -> str:
    return (
        f"the vertical is in doubt: the {_named(side)} of the images is taken as up, but floor and "
        f"walls may also fit the {_named(rival)}; --dataset.up {rival} (or {side}) states it"
    )


def _named(side: ImageSide) -> str:
    return f"{side} side" if side in ("left", "right") else side
