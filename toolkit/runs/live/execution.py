"""Execute a live run: from a camera to a finished run folder."""

from __future__ import annotations

import logging
import math
import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from toolkit.base.errors import CameraError, DatasetError, SettingsError, ToolkitError
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.registry import open_dataset
from toolkit.datasets.resize import ImageGrid
from toolkit.datasets.samples import spread_frames
from toolkit.runs.building import build_slam
from toolkit.runs.checkpoint_writer import CheckpointWriter
from toolkit.runs.evaluation.frame_costs import FrameCostRecorder
from toolkit.runs.evaluation.timing import StageRecorder
from toolkit.runs.execution import check_settings
from toolkit.runs.folder import RunFolder
from toolkit.runs.image_side import FoundSide, find_side, side_seen_afterwards, up_side
from toolkit.runs.live.camera import LiveCamera
from toolkit.runs.live.feed import FeedOptions, LiveFeed
from toolkit.runs.live.frame_writer import FrameWriter
from toolkit.runs.live.options import LiveOptions
from toolkit.runs.live.summary import LiveSummary
from toolkit.runs.live.system import LiveSlam
from toolkit.runs.lock import locked
from toolkit.runs.maps.locations import absolute, with_absolute_paths
from toolkit.runs.maps.saved_map import load_saved_map, open_saved_map
from toolkit.runs.modes import mode_of
from toolkit.runs.observers import Observers, Progress, ProgressObserver, no_progress
from toolkit.runs.outcome import RunRecord
from toolkit.runs.results import write_results
from toolkit.runs.scoring import load_lpips
from toolkit.runs.session import Session
from toolkit.runs.settings import RunSettings, dump_settings
from toolkit.runs.snapshots import SnapshotWriter
from toolkit.runs.stopping import StopSignals
from toolkit.slam.pacing.delays import count_of, delay_statistics
from toolkit.slam.pacing.paced import PacedSlam
from toolkit.slam.system import Slam

_log = logging.getLogger(__name__)

RECORDING = "recording"
# Nominal rate of a recording whose camera does not report one.
_FPS = 30.0


@dataclass(frozen=True, eq=False)
class LiveHooks:
    """What ends a live run and follows its progress.

    Attributes:
        stop: is set to end the run; the map is finished then.
        signals: end the run with a checkpoint instead, if `stop` is set as well.
        progress: wraps the frames in a progress bar.
        observers: follow the progress, for instance a recording or a viewer.
    """

    stop: threading.Event = field(default_factory=threading.Event)
    signals: StopSignals = field(default_factory=StopSignals)
    progress: Progress = no_progress
    observers: Sequence[ProgressObserver] = ()


@dataclass(frozen=True, eq=False)
class _Source:
    """A started camera.

    Attributes:
        camera: the device or the replay.
        intrinsics: of its frames, before they are resampled.
        grid: to which its frames are resampled, None for a replay, whose dataset does that.
        writer: stores its frames, or None.
    """

    camera: LiveCamera
    intrinsics: Camera
    grid: ImageGrid | None
    writer: FrameWriter | None


def run_live(
    settings: RunSettings,
    options: LiveOptions,
    camera: LiveCamera,
    out: str | os.PathLike[str],
    hooks: LiveHooks,
) -> None:
    """Track and map the frames of a live camera, and write the run folder.

    The results are those of `run`. Frames that arrive while SLAM is busy are dropped, except for
    the newest one.

    Args:
        settings: of the run; the dataset is that of a replay. Of a camera, only the side of its
            images that is up is used.
        options: of the camera.
        camera: not started.
        out: the run folder, new or empty.
        hooks: end the run and follow its progress.

    Raises:
        CameraError: the camera is missing, or was disconnected. In the second case, the results of
            the frames before are complete.
        Stopped: a signal ended the run; `run` can resume it.
        ToolkitError: bad settings, data or output folder.
    """
    check_live_settings(settings)
    out = Path(out)
    settings = with_absolute_paths(settings)
    if camera.dataset is None:
        up = settings.dataset.up
        place = DatasetOptions(kind="folder", path=absolute(out) / RECORDING, up=up)
        settings = replace(settings, dataset=place)
    load_lpips(settings)  # reports unusable weights before the run instead of after it
    try:
        intrinsics = camera.start()
        folder = RunFolder.create(out, dump_settings(settings))
        source = _source(camera, intrinsics, settings, options, folder)
        try:
            with locked(out):
                _execute(settings, options, source, folder, hooks)
        except Exception as error:
            if not (folder.checkpoints or folder.is_finished):
                # Frames that could not be mapped are removed; others can be processed again.
                unusable = isinstance(error, CameraError | DatasetError)
                if source.writer is not None and unusable and not options.save_frames:
                    source.writer.remove()
                folder.discard()
            raise
    finally:
        camera.stop()


def check_live_settings(settings: RunSettings) -> None:
    """Reject what does not work with a live camera.

    Raises:
        SettingsError: with the option to remove.
    """
    if not mode_of(settings).needs_depth:
        raise SettingsError("live cameras need depth; remove --depth none")
    check_settings(settings)


def _source(
    camera: LiveCamera,
    intrinsics: Camera,
    settings: RunSettings,
    options: LiveOptions,
    folder: RunFolder,
) -> _Source:
    grid = writer = None
    if camera.dataset is None and settings.image_size is not None:
        grid = ImageGrid(intrinsics, settings.image_size)
    # The evaluation reads the images of the frames again, and a camera shows them only once.
    if options.save_frames or camera.dataset is None:
        fps = options.fps or _FPS
        writer = FrameWriter(folder.path / RECORDING, intrinsics, camera.depth_scale, fps)
    return _Source(camera, intrinsics, grid, writer)


def _execute(
    settings: RunSettings,
    options: LiveOptions,
    source: _Source,
    folder: RunFolder,
    hooks: LiveHooks,
) -> None:
    camera, replayed = source.camera, source.camera.dataset
    recorder = StageRecorder()
    up = FoundSide(up_side(settings.dataset))
    if replayed is not None:
        up = find_side(replayed, spread_frames(replayed), settings.dataset)
        replayed.recording.kept.clear()
    stated, settings = settings.dataset, up.chosen(settings)
    slam = build_slam(replayed, settings, folder, recorder)
    paced = PacedSlam(slam, settings.pace, settings.pacing) if settings.pace else None
    folder.check_taxonomy(slam.result().taxonomy)
    # A dataset may have pauses; a camera has none.
    timeout_s = options.timeout_s if replayed is None else math.inf
    limits = FeedOptions(_capacity(settings), timeout_s, settings.max_frames)
    feed = LiveFeed(camera, limits, hooks.stop, source.grid, source.writer)
    system = LiveSlam(slam, paced, feed, keeps_dropped=replayed is not None)
    intrinsics = source.intrinsics if source.grid is None else source.grid.camera
    observers = Observers([SnapshotWriter(), *hooks.observers])
    costs = FrameCostRecorder(recorder)
    session = Session(camera.name, intrinsics, settings, folder, slam, system, costs, observers)
    checkpoints = CheckpointWriter(folder, background=True)
    with session.open():
        saved = open_saved_map(settings, replayed)
        if saved is not None:
            load_saved_map(slam, saved, folder)
        _log.info(
            "Frames come from %s; the results depend on the speed of this machine and are not "
            "reproducible.",
            camera.name,
        )
        total = None if replayed is None else len(replayed)
        session.process(hooks.progress(feed, total, 0), checkpoints)
        camera.stop()
        failure = feed.failure or _closed(source.writer)
        if failure is not None:
            _log.warning("The recording ended early; the map so far is finished: %s", failure)
        summary = _logged(system.summary(camera.name))
        if not slam.result().keyframe_indices:
            raise failure or DatasetError(
                f"no frame of {camera.name} could start a map; check that the frames have depth"
            )
        if replayed is None:
            frames = _stored(settings, feed.taken, failure)
            up = _side_seen(frames, stated, slam)
        else:
            frames = _first(replayed, settings, len(summary.delays))
        checkpoints.save(system, len(frames))
        checkpoints.wait()
        hooks.signals.check()
        result = session.finish(hooks.progress)
        record = RunRecord(
            recorder, costs.costs(), summary, findings=up.findings, sources=slam.sources
        )
        write_results(result, frames, folder, up.chosen(settings), record)
        session.close_results()
    if source.writer is not None and not options.save_frames:
        source.writer.remove()
        _log.info("Removed the frames of the camera; --save-frames keeps them.")
    if failure is not None:
        raise type(failure)(f"{failure}; the map so far was saved in {folder.path}")


def _side_seen(frames: RecordedDataset, stated: DatasetOptions, slam: Slam) -> FoundSide:
    """The side that was up in the frames of a camera, as far as they were stored."""
    up = side_seen_afterwards(frames, stated)
    frames.recording.kept.clear()
    for finding in up.findings:
        _log.warning("%s: %s", frames.name, finding)
    slam.up_side = up.side
    return up


def _closed(writer: FrameWriter | None) -> ToolkitError | None:
    """Complete the stored frames; return why that failed, or None."""
    try:
        if writer is not None:
            writer.close()
    except ToolkitError as error:
        return error
    return None


def _capacity(settings: RunSettings) -> int:
    """Number of frames that may wait.

    With --pace, SLAM itself decides which frames are dropped, within the maximum delay.
    """
    if settings.pace == 0:
        return 1
    return 1 + math.ceil(settings.pacing.max_delay_s * settings.pace)


def _stored(settings: RunSettings, count: int, failure: ToolkitError | None) -> RecordedDataset:
    """The frames of a camera that the run has stored, for its evaluation.

    Args:
        count: number of frames that were processed.
        failure: why storing them has failed, or None.
    """
    assert settings.dataset.path is not None
    try:
        dataset = open_dataset("folder", settings.dataset.path, settings.image_size)
    except DatasetError as error:
        raise failure or error from error
    if failure is not None and len(dataset) < count:
        raise failure
    return dataset


def _first(dataset: RecordedDataset, settings: RunSettings, count: int) -> RecordedDataset:
    """The first frames of a dataset: those that a run has seen."""
    return RecordedDataset(dataset.recording, settings.image_size, count)


def _logged(summary: LiveSummary) -> LiveSummary:
    delays = delay_statistics(summary.delays)
    if delays["delay_median_ms"] is not None:
        _log.info(
            "Delay from capture to pose: median %.0f ms, 95th percentile %.0f ms, maximum %.0f ms.",
            *(delays[f"delay_{name}_ms"] for name in ("median", "p95", "max")),
        )
    level = logging.WARNING if summary.dropped else logging.INFO
    _log.log(
        level,
        "Dropped %d of %d frames; %d frames are doubtful and %d lost.",
        summary.dropped,
        len(summary.delays),
        count_of("doubtful", summary.delays),
        count_of("lost", summary.delays),
    )
    return summary
