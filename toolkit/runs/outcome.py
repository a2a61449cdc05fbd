"""What a finished run leaves in memory, from which its results are written."""

from __future__ import annotations

from dataclasses import dataclass

from toolkit.base.stages import Stage
from toolkit.datasets.base import Dataset
from toolkit.depth.monocular.motion import CameraMotion
from toolkit.io.length_names import LengthNames
from toolkit.runs.depth_prior_use import DepthPriorUse
from toolkit.runs.evaluation.frame_costs import FrameCosts, gaussian_bytes, peak_memory_mb
from toolkit.runs.evaluation.frame_states import (
    FrameState,
    PartSummary,
    frame_states,
    part_summaries,
)
from toolkit.runs.evaluation.metrics import RunCosts
from toolkit.runs.evaluation.run_metrics import TrackedFrame
from toolkit.runs.evaluation.timing import StageRecorder
from toolkit.runs.settings import RunSettings
from toolkit.slam.frame_preparation import FrameSources
from toolkit.slam.pacing.delays import DelaySummary
from toolkit.slam.result import SlamResult


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

    @property
    def is_metric(self) -> bool:
        """Whether the unit of length is the metre."""
        if self.motion is not None:
            return self.motion.metric_scale is not None
        correction = None if self.prior is None else self.prior.correction
        return correction is None or correction.metric


@dataclass(frozen=True)
class RunOutcome:
    """A finished run.

    Attributes:
        result: of SLAM.
        dataset: its frames.
        settings: of the run.
        record: how the result came about.
        tracked: all frames with a pose.
        states: states of all frames, in order.
        parts: parts of the map, the main part first.
        names: of lengths.
    """

    result: SlamResult
    dataset: Dataset
    settings: RunSettings
    record: RunRecord
    tracked: list[TrackedFrame]
    states: list[FrameState]
    parts: list[PartSummary]
    names: LengthNames

    @classmethod
    def of(
        cls, result: SlamResult, dataset: Dataset, settings: RunSettings, record: RunRecord
    ) -> RunOutcome:
        """Describe the frames of a run."""
        return cls(
            result,
            dataset,
            settings,
            record,
            tracked_frames(result, settings),
            frame_states(result),
            part_summaries(result),
            LengthNames(record.is_metric),
        )

    def costs(self, gaussians: int) -> RunCosts:
        """Return time and memory of the run so far.

        Args:
            gaussians: their number in the map.
        """
        recorder, columns_ms = self.record.recorder, self.record.costs.columns_ms
        return RunCosts(
            frames=len(self.dataset),
            columns_ms={column: float(ms.sum()) for column, ms in columns_ms.items()},
            refinement_ms=recorder.total_ms(Stage.REFINEMENT),
            online_ms=recorder.total_ms(Stage.ONLINE),
            total_ms=recorder.total_ms(Stage.MOTION, Stage.ONLINE, Stage.FINISH),
            peak_memory_mb=peak_memory_mb(),
            map_mb=gaussians * gaussian_bytes(self.result.semantics.channels) / 1e6,
        )


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
