"""Execute a run: from settings to a finished run folder, with checkpoints on the way."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from toolkit.datasets.base import Dataset, RecordedDataset
from toolkit.datasets.findings import quick_findings
from toolkit.datasets.pose_convention import judge_convention
from toolkit.datasets.prefetch import prefetched
from toolkit.depth_priors.factory import build_provider
from toolkit.errors import DatasetError, RunFolderError, SettingsError
from toolkit.evaluation.frame_costs import FrameCostRecorder
from toolkit.evaluation.timing import StageRecorder
from toolkit.frame import Frame
from toolkit.monocular.given import motion_of_given_poses
from toolkit.monocular.motion import FOCAL_ROUNDS, CameraMotion, estimate_motion
from toolkit.monocular.options import ScaleOptions
from toolkit.monocular.scale import check_scale, with_metric_scale
from toolkit.monocular.sequence import MonocularSequence
from toolkit.pacing.paced import PacedSlam
from toolkit.pacing.record import PaceSummary, count_of
from toolkit.runs.building import build_slam
from toolkit.runs.checkpoint_writer import CheckpointWriter
from toolkit.runs.depth_prior_use import DepthPriorUse, inferred_fraction
from toolkit.runs.evaluation import load_lpips
from toolkit.runs.expected_time import ExpectedTime, with_expected_motion_time
from toolkit.runs.finished import FinishedRun
from toolkit.runs.folder import RunFolder
from toolkit.runs.locations import with_absolute_paths
from toolkit.runs.lock import locked
from toolkit.runs.observers import Observers, ProgressObserver
from toolkit.runs.recordings import open_recording
from toolkit.runs.results import (
    RunRecord,
    write_motion_alone,
    write_results,
)
from toolkit.runs.saved_map import load_saved_map, open_saved_map
from toolkit.runs.session import Session, logged_to
from toolkit.runs.settings import RunSettings, dump_settings
from toolkit.runs.snapshots import SnapshotWriter
from toolkit.slam.system import Slam
from toolkit.stages import Stage
from toolkit.synthetic_rooms import RoomSettings, make_room

_log = logging.getLogger(__name__)

# Wraps frames in a progress bar; arguments: frames, total number if known, index of the first one.
Progress = Callable[[Iterable[Frame], int | None, int], Iterable[Frame]]


def no_progress(frames: Iterable[Frame], _total: int | None, _first: int) -> Iterable[Frame]:
    return frames


def run(
    settings: RunSettings,
    out: str | os.PathLike[str],
    resume: bool = False,
    progress: Progress = no_progress,
    observers: Sequence[ProgressObserver] = (),
) -> None:
    """Track and map a dataset, evaluate the result and write the run folder.

    Args:
        settings: of the run. A synthetic run without a dataset path creates the default room
            beside `out`.
        out: the run folder; new or empty unless the run is resumed.
        resume: continue from the last checkpoint in `out`.
        progress: wraps the frames in a progress bar.
        observers: follow the progress, for instance a recording or a viewer.

    Raises:
        ToolkitError: bad settings, data or output folder, or another process runs in it.
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
    has_checkpoint = resume and RunFolder(out).has_checkpoint
    saved = None if has_checkpoint else open_saved_map(settings, dataset)
    folder = RunFolder.open(out) if resume else RunFolder.create(out, config)
    with locked(out):
        if resume:
            folder.check_config(config)
            folder.remove_leftovers()
        try:
            followers = Observers([SnapshotWriter(), *observers])
            _execute(settings, dataset, folder, saved, progress, followers)
        except Exception:
            # Without a checkpoint there is nothing to resume.
            if not resume and not folder.has_checkpoint:
                folder.discard()
            raise


def _execute(
    settings: RunSettings,
    dataset: RecordedDataset,
    folder: RunFolder,
    saved: FinishedRun | None,
    progress: Progress,
    observers: Observers,
) -> None:
    findings = _findings(dataset, settings)
    recorder = StageRecorder()
    sequence: Dataset = dataset
    motion, correction = None, None
    # Missing weights are reported before the motion is estimated.
    provider = build_provider(settings.depth_prior, dataset.stems, dataset.recording.camera)
    if settings.depth == "none":
        with recorder.timed(Stage.MOTION), logged_to(folder.log):
            motion = _motion(dataset, settings, progress)
            if not motion.views:
                write_motion_alone(motion, folder)
                return
        monocular = MonocularSequence(dataset, motion, provider, settings.depth_prior)
        sequence, correction = monocular, monocular.correction()
    slam = build_slam(sequence, settings, folder, recorder, correction)
    paced = PacedSlam(slam, settings.pace, settings.pacing) if settings.pace else None
    system = slam if paced is None else paced
    folder.check_taxonomy(slam.result().taxonomy)
    start = _restore(system, dataset, folder)
    checkpoints = CheckpointWriter(folder, background=paced is not None)
    costs = FrameCostRecorder(recorder)
    session = Session(
        dataset.name, dataset.camera, settings, folder, slam, system, costs, observers
    )
    with session.open():
        for finding in findings:
            _log.warning("%s: %s", dataset.name, finding)
        if settings.poses == "given" and dataset.origin_m.any():
            _log.info(
                "The map is relative to the origin %s, because its coordinates are too large; "
                "exports contain them again.",
                " ".join(f"{value:.0f}" for value in dataset.origin_m),
            )
        if start is not None:
            _log.info("Resumed %s at frame %d of %d.", folder.path, start, len(dataset))
        if saved is not None:
            load_saved_map(slam, saved)
            # The checkpoint contains the saved map, so that resuming does not need the saved run.
            checkpoints.save(system, 0)
        indices = range(start or 0, len(dataset))
        expected = ExpectedTime(settings, dataset.camera, indices, recorder)
        frames = progress(
            prefetched(sequence, indices, prepare=slam.prepare), len(dataset), indices.start
        )
        if paced is not None:
            _log.info(
                "Frames arrive at %g per second; the results depend on the speed of this machine "
                "and are not reproducible.",
                settings.pace,
            )
            frames = paced.arriving(frames)
        session.process(frames, checkpoints, expected)
        if not slam.result().keyframe_indices:
            raise DatasetError(
                f"no frame of {settings.dataset.path} could start a map; check that the frames "
                "have depth"
            )
        checkpoints.save(system, len(dataset))
        checkpoints.wait()
        pace = None if paced is None else _log_pace(paced.summary())
        result = session.finish()
        prior = None
        if provider is not None:
            prior = DepthPriorUse(provider.model, inferred_fraction(slam.atlas), correction)
        record = RunRecord(recorder, costs.costs(), pace, motion, prior, findings)
        write_results(result, dataset, folder, settings, record)
        slam.store_in_metres()


def _findings(dataset: RecordedDataset, settings: RunSettings) -> tuple[str, ...]:
    """What a few frames show to be wrong with a recording, one line each.

    Raises:
        DatasetError: poses that the run needs contradict its images.
    """
    if settings.depth == "none":
        return ()
    findings = quick_findings(dataset)
    convention = judge_convention(dataset)
    verdict = convention.verdict() if convention else None
    if verdict is None:
        return findings
    if settings.poses == "given" and settings.dataset.pose_convention == "check":
        raise DatasetError(
            f"{settings.dataset.path}: {verdict}; correct them, or convert them with "
            f"--dataset.pose-convention correct (trust uses them as they are)"
        )
    if settings.poses == "slam":
        verdict += "; the errors of the trajectory are wrong"
    return (*findings, verdict)


def check_settings(settings: RunSettings) -> None:
    """Reject what does not work without a depth sensor.

    Raises:
        SettingsError: with the option to remove.
    """
    check_scale(settings.scale)
    if settings.depth == "sensor":
        if settings.scale != ScaleOptions():
            raise SettingsError("--scale is for runs without depth; remove it, or add --depth none")
        if settings.depth_prior.kind != "none":
            raise SettingsError("--depth-prior.kind replaces a depth sensor; add --depth none")
        return
    for name, used in {
        "--pace": settings.pace,
        "--map": settings.map,
    }.items():
        if used:
            raise SettingsError(f"{name} needs depth images; remove it, or remove --depth none")


def _motion(dataset: RecordedDataset, settings: RunSettings, progress: Progress) -> CameraMotion:
    """Estimate the motion of the camera from the images alone, and log what is not certain."""
    if settings.poses == "given":
        return _given_motion(dataset, settings, progress)
    _log.info("Estimating the motion of the camera from the images.")
    total = len(dataset)
    calibrated = dataset.recording.calibrated
    passes = 1 if calibrated else FOCAL_ROUNDS
    begun = False

    def watched(frames: Iterable[Frame]) -> Iterable[Frame]:
        """Frames with a progress bar; the first pass states how long it takes."""
        nonlocal begun
        if not begun:
            frames = with_expected_motion_time(frames, total, passes)
        begun = True
        return progress(frames, total, 0)

    motion = estimate_motion(
        dataset,
        dataset.camera,
        calibrated,
        focal_sigma=dataset.recording.focal_sigma,
        progress=watched,
    )
    if not calibrated:
        _log.info("The focal length is %.0f pixels.", motion.camera.fx)
        dataset.camera = motion.camera
    if motion.views:
        _log.info(
            "Found the motion of %d of %d frames, with %d keyframes.",
            len(motion.trajectory),
            total,
            len(motion.views),
        )
        if motion.others:
            _log.info(
                "%d more frames are in %d other part(s), each with a unit of length of its own.",
                motion.frames_in_others,
                len(motion.others),
            )
        motion = with_metric_scale(motion, dataset, dataset.timestamps_s, settings.scale)
    if motion.metric_scale is not None:
        _log.info(
            "The unit of length is the metre, by %s (uncertain by %.1f %%).",
            motion.metric_scale.source,
            100.0 * motion.metric_scale.sigma,
        )
    for doubt in motion.doubts:
        _log.warning("The result is not reliable: %s.", doubt)
    if motion.doubts and dataset.ground_truth is not None and calibrated:
        _log.warning("The dataset has poses; --poses given uses them instead.")
    return motion


def _given_motion(
    dataset: RecordedDataset, settings: RunSettings, progress: Progress
) -> CameraMotion:
    """The motion by the poses of the dataset, with keyframes whose depth can be estimated."""
    if dataset.ground_truth is None:
        raise DatasetError(f"{settings.dataset.path} has no poses; remove --poses given")
    if not dataset.recording.calibrated:
        raise DatasetError(
            f"{settings.dataset.path} has no intrinsics, which given poses need; add them "
            "(docs/guides/datasets.md), or specify --dataset.fov-deg"
        )
    _log.info("Matching images at the given poses.")
    # The models of COLMAP, and what was made from them, have an arbitrary unit.
    metric = settings.dataset.kind not in ("colmap", "nerfstudio")
    frames = progress(iter(dataset), len(dataset), 0)
    try:
        motion = motion_of_given_poses(frames, dataset.camera, dataset.ground_truth, metric)
    except DatasetError as error:
        raise DatasetError(f"{settings.dataset.path}: {error}") from error
    _log.info("The depth of %d keyframes can be estimated.", len(motion.views))
    return motion


def _restore(system: Slam | PacedSlam, dataset: Dataset, folder: RunFolder) -> int | None:
    """Restore the newest checkpoint.

    Returns:
        The frame at which to continue, None without a checkpoint.

    Raises:
        RunFolderError: the checkpoint is damaged or belongs to another sequence.
    """
    checkpoint = folder.load_checkpoint()
    if checkpoint is None:
        return None
    if not 0 <= checkpoint.next_frame <= len(dataset):
        raise RunFolderError(
            f"the checkpoint in {folder.checkpoints} is at frame {checkpoint.next_frame}, but "
            f"{dataset.name} has {len(dataset)} frames; resume with the run's dataset"
        )
    try:
        system.restore(checkpoint.arrays, checkpoint.values)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise RunFolderError(
            f"the checkpoint in {folder.checkpoints} is damaged ({error!r}); start a new run"
        ) from error
    return checkpoint.next_frame


def _dataset_path(settings: RunSettings, out: Path, resume: bool, progress: Progress) -> Path:
    """Return the folder of the dataset; create the default room for a synthetic run without one."""
    if settings.dataset.path is not None:
        return settings.dataset.path
    if settings.dataset.kind != "synthetic":
        raise SettingsError(f"dataset.kind '{settings.dataset.kind}' requires dataset.path")
    room = out.with_name(out.name + "_room")
    if not resume and not (room / "traj.txt").exists():
        _log.info("Creating a synthetic room in %s.", room)
        make_room(
            room, RoomSettings(seed=settings.seed), lambda frames, total: progress(frames, total, 0)
        )
    return room


def _with_path(settings: RunSettings, path: Path) -> RunSettings:
    return replace(settings, dataset=replace(settings.dataset, path=path))


def _log_pace(summary: PaceSummary) -> PaceSummary:
    metrics, steps = summary.metrics(), summary.steps
    if metrics["delay_median_ms"] is not None:
        _log.info(
            "Delay from arrival to pose: median %.0f ms, 95th percentile %.0f ms, maximum %.0f ms.",
            *(metrics[f"delay_{name}_ms"] for name in ("median", "p95", "max")),
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
