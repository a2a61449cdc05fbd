"""Execute a run: from settings to a finished run folder, with checkpoints on the way."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from toolkit.base.errors import DatasetError, RunFolderError, SettingsError
from toolkit.base.frame import Frame
from toolkit.datasets.base import Dataset, RecordedDataset
from toolkit.datasets.faults import fault_tolerant
from toolkit.datasets.prefetch import prefetched
from toolkit.datasets.samples import spread_frames
from toolkit.datasets.synthetic_rooms import RoomSettings, make_room
from toolkit.depth.depth_priors.factory import build_provider
from toolkit.depth.monocular.scale import check_scale
from toolkit.runs.building import build_slam
from toolkit.runs.checkpoint_writer import CheckpointWriter
from toolkit.runs.depth_prior_use import DepthPriorUse, inferred_fraction
from toolkit.runs.evaluation.frame_costs import FrameCostRecorder
from toolkit.runs.evaluation.timing import StageRecorder
from toolkit.runs.expected_time import ExpectedTime
from toolkit.runs.folder import RunFolder
from toolkit.runs.image_side import FoundSide, find_side
from toolkit.runs.lock import locked
from toolkit.runs.maps.locations import with_absolute_paths
from toolkit.runs.maps.saved_map import SavedMap, load_saved_map, open_saved_map
from toolkit.runs.modes import RunContext, RunMode, mode_of
from toolkit.runs.observers import Observers, Progress, ProgressObserver, no_progress
from toolkit.runs.outcome import RunRecord
from toolkit.runs.processed_frames import Identity, check_identity, identity_of
from toolkit.runs.recordings import open_recording
from toolkit.runs.results import write_motion_alone, write_results
from toolkit.runs.scoring import load_lpips
from toolkit.runs.session import Session, logged_to
from toolkit.runs.settings import RunSettings, dump_settings
from toolkit.runs.snapshots import SnapshotWriter
from toolkit.runs.stopping import StopSignals
from toolkit.semantics.decoder import check_reader
from toolkit.slam.pacing.delays import PaceSummary, count_of, delay_statistics
from toolkit.slam.pacing.paced import PacedSlam
from toolkit.slam.system import Slam

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class _Hooks:
    """What follows the progress of a run and ends it; see `run`."""

    progress: Progress
    observers: Observers
    stop: StopSignals


def run(
    settings: RunSettings,
    out: str | os.PathLike[str],
    resume: bool = False,
    progress: Progress = no_progress,
    observers: Sequence[ProgressObserver] = (),
    stop: StopSignals | None = None,
) -> None:
    """Track and map a dataset, evaluate the result and write the run folder.

    Args:
        settings: of the run. A synthetic run without a dataset path creates the default room
            beside `out`.
        out: the run folder; new or empty unless the run is resumed.
        resume: continue from the last checkpoint in `out`.
        progress: wraps the frames in a progress bar.
        observers: follow the progress, for instance a recording or a viewer.
        stop: signals that end the run with a checkpoint.

    Raises:
        ToolkitError: bad settings, data or output folder, or another process runs in it.
        Stopped: a signal ends the run.
    """
    check_settings(settings)
    out = Path(out)
    path = _dataset_path(settings, out, resume, progress)
    settings = with_absolute_paths(_with_path(settings, path))
    dataset = open_recording(settings, path)
    check_scale(settings.scale, len(dataset))
    config = dump_settings(settings)
    load_lpips(settings)  # reports unusable weights before the run instead of after it
    # Check the saved map before the folder is created. A checkpoint already contains the map.
    has_checkpoint = resume and bool(RunFolder(out).checkpoints)
    saved = None if has_checkpoint else open_saved_map(settings, dataset)
    folder = RunFolder.open(out) if resume else RunFolder.create(out, config)
    with locked(out):
        if resume:
            folder.check_config(config)
        folder.remove_leftovers()
        if resume:
            folder.prepare()
            if folder.is_finished and not folder.checkpoints:
                _log.info("%s is finished; there is nothing to resume.", out)
                return
        try:
            followers = Observers([SnapshotWriter(), *observers])
            hooks = _Hooks(progress, followers, stop or StopSignals())
            _execute(settings, dataset, folder, saved, hooks)
        except Exception:
            # Without a checkpoint there is nothing to resume.
            if not (resume or folder.checkpoints or folder.is_finished):
                folder.discard()
            raise


def _execute(
    settings: RunSettings,
    dataset: RecordedDataset,
    folder: RunFolder,
    saved: SavedMap | None,
    hooks: _Hooks,
) -> None:
    progress, stop = hooks.progress, hooks.stop
    mode, recorder = mode_of(settings), StageRecorder()
    up, findings = _examined(dataset, settings)
    # Missing weights are reported before the motion is estimated.
    provider = build_provider(settings.depth_prior, dataset.stems, dataset.recording.camera)
    with logged_to(folder.log):
        source = mode.open(RunContext(settings, dataset, recorder, provider, progress))
    up = source.up or up
    settings = up.chosen(settings)
    if source.motion is not None and not source.motion.views:
        write_motion_alone(source.motion, folder)
        return
    slam = build_slam(source.frames, settings, folder, recorder, source.correction)
    paced = PacedSlam(slam, settings.pace, settings.pacing) if settings.pace else None
    system = slam if paced is None else paced
    folder.check_taxonomy(slam.taxonomy)
    identity = partial(identity_of, dataset, given_poses=mode.given_poses)
    start = _restore(system, dataset, folder, identity)
    checkpoints = CheckpointWriter(folder, paced is not None, identity)
    costs = FrameCostRecorder(recorder)
    session = Session(
        dataset.name, dataset.camera, settings, folder, slam, system, costs, hooks.observers, stop
    )
    with session.open():
        for note in up.notes:
            _log.info("%s: %s; --dataset.up states another side.", dataset.name, note)
        findings = (*findings, *up.findings)
        _log_findings(mode, dataset, findings)
        if start is not None:
            _log.info("Resumed %s at frame %d of %d.", folder.path, start, len(dataset))
        if saved is not None:
            load_saved_map(slam, saved, folder)
            # The checkpoint contains the saved map, so that resuming does not need the saved run.
            checkpoints.save(system, 0)
        indices = range(start or 0, len(dataset))
        expected = ExpectedTime(settings, dataset.camera, indices, recorder)
        read = prefetched(fault_tolerant(source.frames), indices, prepare=slam.prepare)
        frames = progress(read, len(dataset), indices.start)
        if paced is not None:
            frames = _arriving(frames, paced, settings)
        session.process(frames, checkpoints, expected)
        if not slam.result().keyframe_indices:
            raise DatasetError(
                f"no frame of {settings.dataset.path} could start a map; check that the frames "
                "have depth"
            )
        checkpoints.save(system, len(dataset))
        checkpoints.wait()
        stop.check()
        pace = None if paced is None else _log_pace(paced.summary())
        result = session.finish(progress)
        prior = None
        if provider is not None:
            prior = DepthPriorUse(provider.model, inferred_fraction(slam.atlas), source.correction)
        record = RunRecord(
            recorder, costs.costs(), pace, source.motion, prior, findings, slam.sources
        )
        write_results(result, dataset, folder, settings, record)
        session.close_results()


def _examined(dataset: RecordedDataset, settings: RunSettings) -> tuple[FoundSide, tuple[str, ...]]:
    """The side of the images that is up, and what a few frames show to be wrong."""
    mode = mode_of(settings)
    frames = [*spread_frames(dataset)] if mode.needs_depth else []
    up = find_side(dataset, frames, settings.dataset)
    findings = mode.findings(dataset, frames, up.chosen(settings))
    dataset.recording.kept.clear()
    return up, findings


def _log_findings(mode: RunMode, dataset: RecordedDataset, findings: Sequence[str]) -> None:
    for finding in findings:
        _log.warning("%s: %s", dataset.name, finding)
    origin_m = mode.origin_m(dataset)
    if origin_m is not None and origin_m.any():
        _log.info(
            "The map is relative to the origin %s, because its coordinates are too large; "
            "exports contain them again.",
            " ".join(f"{value:.0f}" for value in origin_m),
        )


def _arriving(frames: Iterable[Frame], paced: PacedSlam, settings: RunSettings) -> Iterable[Frame]:
    _log.info(
        "Frames arrive at %g per second; the results depend on the speed of this machine "
        "and are not reproducible.",
        settings.pace,
    )
    return paced.arriving(frames)


def check_settings(settings: RunSettings) -> None:
    """Reject options that do not work together.

    Raises:
        SettingsError: with the option to remove.
    """
    check_scale(settings.scale)
    check_reader(settings.semantics)
    mode_of(settings).check(settings)


def _restore(
    system: Slam | PacedSlam,
    dataset: Dataset,
    folder: RunFolder,
    identity: Callable[[int], Identity],
) -> int | None:
    """Restore the newest checkpoint.

    Args:
        identity: identifies a number of frames from the start of the dataset.

    Returns:
        The frame at which to continue, None without a checkpoint.
    """
    checkpoint = folder.checkpoints.load()
    if checkpoint is None:
        return None
    if not 0 <= checkpoint.next_frame <= len(dataset):
        raise RunFolderError(
            f"the checkpoint in {folder.checkpoints.path} is at frame {checkpoint.next_frame}, but "
            f"{dataset.name} has {len(dataset)} frames; resume with the run's dataset"
        )
    check_identity(checkpoint.frames, identity(checkpoint.next_frame), folder.path)
    try:
        system.restore(checkpoint.arrays, checkpoint.values)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise RunFolderError(
            f"the checkpoint in {folder.checkpoints.path} is damaged ({error!r}); start a new run"
        ) from error
    return checkpoint.next_frame


def _dataset_path(settings: RunSettings, out: Path, resume: bool, progress: Progress) -> Path:
    """Return the folder of the dataset; create the default room for a synthetic run without one."""
    if settings.dataset.path is not None:
        return settings.dataset.path
    if settings.dataset.kind != "synthetic":
        raise SettingsError(f"dataset.kind '{settings.dataset.kind}' requires dataset.path")
    room = out.with_name(out.name + "_room")
    if resume and not room.exists():
        raise SettingsError(
            f"--resume needs the settings of the run: add --config {out / 'config.yaml'}"
        )
    if not resume and not (room / "traj.txt").exists():
        _log.info("Creating a synthetic room in %s.", room)
        make_room(
            room, RoomSettings(seed=settings.seed), lambda frames, total: progress(frames, total, 0)
        )
    return room


def _with_path(settings: RunSettings, path: Path) -> RunSettings:
    return replace(settings, dataset=replace(settings.dataset, path=path))


def _log_pace(summary: PaceSummary) -> PaceSummary:
    delays, steps = delay_statistics(summary.delays), summary.steps
    if delays["delay_median_ms"] is not None:
        _log.info(
            "Delay from arrival to pose: median %.0f ms, 95th percentile %.0f ms, maximum %.0f ms.",
            *(delays[f"delay_{name}_ms"] for name in ("median", "p95", "max")),
        )
    level = logging.WARNING if summary.dropped else logging.INFO
    _log.log(
        level,
        "Dropped %d of %d frames, postponed keyframes in %d frames, and skipped %d of %d "
        "optimisation steps; %d frames are doubtful and %d lost.",
        summary.dropped,
        len(summary.delays),
        summary.keyframes_thinned,
        steps.due - steps.taken,
        steps.due,
        count_of("doubtful", summary.delays),
        count_of("lost", summary.delays),
    )
    return summary
