"""Modes of a run: whether depth is measured or images alone are used, and whether poses are given.

`mode_of` is the only place that asks the settings for it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError, SettingsError, ToolkitError
from toolkit.base.frame import Frame
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.base.stages import Stage
from toolkit.datasets.agreement.findings import contradictions
from toolkit.datasets.base import Dataset, RecordedDataset
from toolkit.datasets.findings import quick_findings
from toolkit.datasets.images_only import ImagesOnly
from toolkit.depth.depth_priors.correction import DepthCorrection
from toolkit.depth.depth_priors.provider import DepthProvider
from toolkit.depth.monocular.motion import CameraMotion
from toolkit.depth.monocular.options import ScaleOptions
from toolkit.depth.monocular.sequence import MonocularSequence, prior_correction
from toolkit.runs.evaluation.timing import StageRecorder
from toolkit.runs.evaluation.trajectory import AlignmentKind
from toolkit.runs.folder import RunFolder
from toolkit.runs.image_side import FoundSide
from toolkit.runs.motion import (
    estimated_motion,
    in_metres,
    log_doubts,
    motion_at_given_poses,
    side_of_motion,
    with_prior_doubts,
)
from toolkit.runs.observers import Progress
from toolkit.runs.settings import RunSettings
from toolkit.semantics.codes import SemanticCode
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.length_unit import METRE, LengthUnit
from toolkit.slam.loops.closing.factory import ClosingContext, build_loop_closer
from toolkit.slam.loops.closing.interface import GivenParts, LoopClosing
from toolkit.slam.loops.log import LoopLog
from toolkit.slam.tracking.factory import build_tracker
from toolkit.slam.tracking.given import GivenPoses
from toolkit.slam.tracking.guided import GuidedTracker
from toolkit.slam.tracking.initial_velocity import initial_velocity
from toolkit.slam.tracking.options import TrackingOptions
from toolkit.slam.tracking.placement import KeyframePlacement


@dataclass(frozen=True)
class RunInput:
    """A dataset, ready to be processed.

    Attributes:
        frames: what is tracked and mapped.
        motion: of the camera, where it is found before the first frame is mapped.
        correction: see `FrontEnd`.
        up: the side of the images that is up, where only the motion shows it.
    """

    frames: Dataset
    motion: CameraMotion | None = None
    correction: DepthCorrection | None = None
    up: FoundSide | None = None


@dataclass(frozen=True)
class RunContext:
    """What the input of a run is opened with.

    Attributes:
        provider: of depth priors, None without.
        progress: wraps frames in a progress bar.
    """

    settings: RunSettings
    dataset: RecordedDataset
    recorder: StageRecorder
    provider: DepthProvider | None
    progress: Progress


@dataclass(frozen=True)
class FrontEndParts:
    """What front ends are built from.

    Attributes:
        settings: of the run.
        dataset: the sequence; None for frames of another source.
        recorder: measures the time of each stage.
        context: of loop closure.
        code: of the semantic features; None without semantics.
        folder: stores the loop log; None keeps it nowhere.
        record_in_metres: converts a record of the loop log from the unit of the system.
        correction: see `FrontEnd`.
    """

    settings: RunSettings
    dataset: Dataset | None
    recorder: StageRecorder
    context: ClosingContext
    code: SemanticCode | None
    folder: RunFolder | None
    record_in_metres: Callable[[Mapping[str, Any]], dict[str, Any]]
    correction: DepthCorrection | None


class RunMode(ABC):
    """What depends on where depth and poses come from.

    Attributes:
        alignment: how the trajectory is aligned with the ground truth.
        needs_depth: whether frames must have depth.
        locates: whether the camera is located in the map, so that it can be relocalised.
        given_poses: whether the dataset gives the poses.
    """

    alignment: ClassVar[AlignmentKind]
    needs_depth: ClassVar[bool]
    locates: ClassVar[bool] = False
    given_poses: ClassVar[bool] = False

    @abstractmethod
    def check(self, settings: RunSettings) -> None:
        """Reject options that do not work in this mode.

        Raises:
            SettingsError: with the option to remove.
        """

    @abstractmethod
    def open(self, run: RunContext) -> RunInput:
        """Prepare the dataset, without depth by finding the motion of the camera."""

    @abstractmethod
    def front_end(self, parts: FrontEndParts) -> FrontEnd:
        """Build what finds the poses of frames.

        Raises:
            ToolkitError: the settings need something that the dataset lacks.
        """

    def findings(
        self, dataset: RecordedDataset, frames: Sequence[Frame], settings: RunSettings
    ) -> tuple[str, ...]:
        """What a few frames show to be wrong with a recording, one line each.

        Args:
            frames: evenly spaced ones with depth; none if the run does not use it.

        Raises:
            DatasetError: poses that the run needs contradict its images.
        """
        return ()

    def origin_m(self, dataset: Dataset) -> NDArray[np.float64] | None:
        """The point [3] that was subtracted from given poses; None without given poses."""
        if self.given_poses and isinstance(dataset, RecordedDataset):
            return dataset.origin_m
        return None


class DepthCamera(RunMode):
    """Depth is measured, and the camera is located in the map."""

    alignment: ClassVar[AlignmentKind] = "se3"
    needs_depth = True
    locates = True

    def check(self, settings: RunSettings) -> None:
        """Reject options of runs without depth."""
        if settings.scale != ScaleOptions():
            raise SettingsError("--scale is for runs without depth; remove it, or add --depth none")
        if settings.depth_prior.kind != "none":
            raise SettingsError("--depth-prior.kind replaces a depth sensor; add --depth none")

    def open(self, run: RunContext) -> RunInput:
        """The dataset as it is."""
        return RunInput(run.dataset)

    def findings(
        self, dataset: RecordedDataset, frames: Sequence[Frame], settings: RunSettings
    ) -> tuple[str, ...]:
        """Those of the quick checks, and intrinsics and poses that contradict the images."""
        quick = quick_findings(frames, dataset.recording.depth_scale)
        found = contradictions(dataset)
        if found.convention is None:
            return (*quick, *found.others)
        return (*quick, self._pose_finding(found.convention, settings))

    def _pose_finding(self, wrong: str, settings: RunSettings) -> str:
        """The line about poses of a wrong convention."""
        return f"{wrong}; the errors of the trajectory are wrong"

    def front_end(self, parts: FrontEndParts) -> FrontEnd:
        """The tracker of the settings, with loop closure."""
        settings = parts.settings
        # A map that is extended may be loaded before the first frame.
        fixed = parts.dataset is None and settings.map is not None
        unit = METRE if fixed else LengthUnit.of(parts.dataset)
        closer: LoopClosing = LoopClosing()
        if settings.loops.use:
            log = None
            if parts.folder is not None:
                log = LoopLog(parts.folder.loops, convert=parts.record_in_metres)
            closer = build_loop_closer(
                settings.loops, parts.context, log, parts.recorder, settings.registration
            )
        tracker = build_tracker(settings.tracking, settings.backend, parts.recorder, parts.code)
        placed = tracker.placed and settings.placement.use
        return FrontEnd(
            tracker,
            closer,
            KeyframePlacement(settings.placement) if placed else None,
            start_velocity=_start_velocity(parts.dataset, unit),
            unit=unit,
        )


class DepthAtGivenPoses(DepthCamera):
    """Depth is measured, and the dataset has the poses."""

    alignment = "none"
    locates = False
    given_poses = True

    def _pose_finding(self, wrong: str, settings: RunSettings) -> str:
        if settings.dataset.pose_convention == "check":
            raise DatasetError(
                f"{settings.dataset.path}: {wrong}; correct them, or convert them with "
                f"--dataset.pose-convention correct (trust uses them as they are)"
            )
        return wrong

    def front_end(self, parts: FrontEndParts) -> FrontEnd:
        """Looks the poses up."""
        unit = LengthUnit.of(parts.dataset)
        trajectory = (unit or METRE).trajectory(_poses_of(parts.dataset))
        return FrontEnd(GivenPoses(trajectory), unit=unit)


class ImagesAlone(RunMode):
    """Motion and depth are found from the images."""

    alignment: ClassVar[AlignmentKind] = "sim3"
    needs_depth = False

    def check(self, settings: RunSettings) -> None:
        """Reject what needs depth images."""
        for name, used in {"--pace": settings.pace, "--map": settings.map}.items():
            if used:
                raise SettingsError(f"{name} needs depth images; remove it, or remove --depth none")
        may_choose = self.given_poses or settings.depth_prior.use == "track"
        if settings.tracking.kind != TrackingOptions.kind and not may_choose:
            raise SettingsError(
                f"--tracking.kind {settings.tracking.kind} needs depth; add --depth-prior.use "
                "track with a source of priors, or remove --depth none"
            )

    def open(self, run: RunContext) -> RunInput:
        """The keyframes of the motion, whose depth is estimated."""
        dataset, settings, up = run.dataset, run.settings, None
        with run.recorder.timed(Stage.MOTION):
            motion = self._motion(run)
            if motion.views:
                up = side_of_motion(motion, dataset, settings.dataset)
                motion = in_metres(motion, dataset, settings.scale, up.side)
        log_doubts(motion, dataset)
        if not motion.views:
            return RunInput(dataset, motion)
        if run.provider is not None:
            motion = with_prior_doubts(motion, dataset, run.provider, settings)
        sequence = MonocularSequence(dataset, motion, run.provider, settings.depth_prior)
        return RunInput(sequence, motion, sequence.correction(), up)

    def _motion(self, run: RunContext) -> CameraMotion:
        return estimated_motion(run.dataset, run.progress)

    def front_end(self, parts: FrontEndParts) -> FrontEnd:
        """Refines the poses of the motion against the map, in the parts of the motion."""
        sequence = parts.dataset
        if not isinstance(sequence, MonocularSequence):
            raise DatasetError("a run without depth needs a MonocularSequence of the dataset")
        return FrontEnd(
            GuidedTracker(sequence.trajectories, parts.settings.backend, parts.recorder),
            GivenParts(sequence.part_of_keyframe),
            correction=parts.correction,
        )


class ImagesWithPriors(ImagesAlone):
    """The camera is located in the map with depth priors, without visual odometry (H, III.C).

    A prior is aligned with the map twice: at the predicted pose, to track its frame, and at the
    tracked pose, to map it. Nothing measures the drift of the scale, so that loops are not closed
    and a lost camera is not relocalised elsewhere in the map.
    """

    def check(self, settings: RunSettings) -> None:
        """Reject what needs depth images or the motion of the whole sequence."""
        super().check(settings)
        if settings.depth_prior.kind == "none":
            raise SettingsError(
                "--depth-prior.use track needs depth priors; set --depth-prior.kind, or remove it "
                "to estimate depth from the images"
            )
        if settings.scale != ScaleOptions():
            raise SettingsError(
                "--scale needs visual odometry; remove it or --depth-prior.use track"
            )

    def open(self, run: RunContext) -> RunInput:
        """The images, whose priors are aligned as they are tracked."""
        assert run.provider is not None, "the settings were checked"
        if not run.dataset.recording.calibrated:
            raise DatasetError(
                f"{run.settings.dataset.path} has no intrinsics, which only visual odometry "
                "estimates; specify --dataset.fov-deg"
            )
        images = ImagesOnly(run.dataset)
        options = run.settings.depth_prior
        return RunInput(images, correction=prior_correction(images, run.provider, options, False))

    def front_end(self, parts: FrontEndParts) -> FrontEnd:
        """The tracker of the settings, without loop closure."""
        settings = parts.settings
        return FrontEnd(
            build_tracker(settings.tracking, settings.backend, parts.recorder, parts.code),
            correction=parts.correction,
            tracks_priors=True,
        )


class ImagesAtGivenPoses(ImagesAlone):
    """Depth is found from the images at the poses of the dataset."""

    alignment = "none"
    given_poses = True

    def check(self, settings: RunSettings) -> None:
        """Reject what needs depth images, and tracking."""
        super().check(settings)
        if settings.depth_prior.use == "track":
            raise SettingsError(
                "--poses given leaves nothing to track; set --depth-prior.use correct"
            )
        if settings.scale != ScaleOptions():
            raise SettingsError("--poses given has the scale of the poses; remove --scale")

    def _motion(self, run: RunContext) -> CameraMotion:
        return motion_at_given_poses(run.dataset, run.settings, run.progress)

    def front_end(self, parts: FrontEndParts) -> FrontEnd:
        """Looks the poses up."""
        return FrontEnd(GivenPoses(_poses_of(parts.dataset)), correction=parts.correction)


def mode_of(settings: RunSettings) -> RunMode:
    """The mode that the settings describe."""
    given = settings.poses == "given"
    if settings.depth == "none":
        if given:
            return ImagesAtGivenPoses()
        return ImagesWithPriors() if settings.depth_prior.use == "track" else ImagesAlone()
    return DepthAtGivenPoses() if given else DepthCamera()


def _poses_of(dataset: Dataset | None) -> Trajectory:
    if dataset is None or dataset.ground_truth is None:
        name = "this sequence" if dataset is None else dataset.name
        raise DatasetError(f"poses 'given' needs poses, but {name} has none; set poses to 'slam'")
    return dataset.ground_truth


def _start_velocity(dataset: Dataset | None, unit: LengthUnit | None) -> NDArray[np.float64] | None:
    """Velocity [6] of a camera with a rolling shutter at the start of a sequence, if known.

    It is estimated before any thread reads the dataset.
    """
    if unit is None:
        return None
    if not isinstance(dataset, RecordedDataset) or dataset.readout_s == 0.0:
        return None
    try:
        return initial_velocity(unit.frame(dataset[0]), unit.frame(dataset[1]))
    except (ToolkitError, IndexError):
        return None  # the file is named when the frame is processed
