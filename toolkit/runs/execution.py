"""Execute a run: from settings to a finished run folder, with checkpoints on the way."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

from toolkit.datasets.base import Dataset
from toolkit.datasets.prefetch import prefetched
from toolkit.datasets.registry import open_dataset
from toolkit.datasets.synthetic import RoomSettings, make_room
from toolkit.errors import DatasetError, SettingsError, ToolkitError
from toolkit.evaluation.timing import StageRecorder
from toolkit.frame import Frame
from toolkit.result import SlamResult
from toolkit.runs.building import build_slam
from toolkit.runs.evaluation import lpips_of
from toolkit.runs.folder import RunFolder
from toolkit.runs.locations import with_absolute_paths
from toolkit.runs.results import held_out, write_results
from toolkit.runs.saved_map import load_saved_map, open_saved_map
from toolkit.runs.settings import RunSettings, dump_settings
from toolkit.slam import Slam

_log = logging.getLogger(__name__)

# Wraps frames in a progress bar: (frames, total, number of the first one).
Progress = Callable[[Iterable[Frame], int, int], Iterable[Frame]]


def _no_progress(frames: Iterable[Frame], _total: int, _first: int) -> Iterable[Frame]:
    return frames


def run(
    settings: RunSettings,
    out: str | os.PathLike[str],
    resume: bool = False,
    progress: Progress = _no_progress,
) -> None:
    """Track and map a dataset, evaluate the result and write the run folder.

    Args:
        settings: of the run. A synthetic run without a dataset path creates the default room
            beside `out`.
        out: the run folder; new or empty unless the run is resumed.
        resume: continue from the last checkpoint in `out`.
        progress: wraps the frames in a progress bar.

    Raises:
        ToolkitError: bad settings, data or output folder.
    """
    out = Path(out)
    path = _dataset_path(settings, out, resume, progress)
    settings = with_absolute_paths(_with_path(settings, path))
    dataset = open_dataset(settings.dataset.kind, path, settings.image_size, settings.max_frames)
    config = dump_settings(settings)
    lpips_of(settings)  # reports unusable weights before the run instead of after it
    # Before the folder is created: the saved map may be unsuitable.
    begun = resume and RunFolder(out).has_checkpoint
    saved = None if begun else open_saved_map(settings, dataset)
    if resume:
        folder = RunFolder.open(out)
        folder.check_config(config)
    else:
        folder = RunFolder.create(out, config)
    watch = StageRecorder()
    try:
        slam = build_slam(dataset, settings, folder, watch)
    except ToolkitError:
        if not resume:
            folder.discard()  # so that the same folder can be given again
        raise
    _log_to(folder.log)
    folder.check_taxonomy(slam.result().taxonomy)
    if saved is not None:
        load_saved_map(slam, saved)
        # The checkpoint holds the saved map, so that resuming does not need the saved run.
        _save(slam, folder, 0)
    result = _process(slam, dataset, folder, settings, watch, progress)
    write_results(result, dataset, folder, settings, watch)


def _dataset_path(settings: RunSettings, out: Path, resume: bool, progress: Progress) -> Path:
    """The folder of the dataset; the default room is created for a synthetic run without one."""
    if settings.dataset.path is not None:
        return settings.dataset.path
    if settings.dataset.kind != "synthetic":
        raise SettingsError(f"--dataset.kind {settings.dataset.kind} needs --dataset.path DIR")
    room = out.with_name(out.name + "_room")
    if not resume and not (room / "traj.txt").exists():
        _log.info("making a synthetic room in %s", room)
        make_room(
            room, RoomSettings(seed=settings.seed), lambda frames, total: progress(frames, total, 0)
        )
    return room


def _with_path(settings: RunSettings, path: Path) -> RunSettings:
    return replace(settings, dataset=replace(settings.dataset, path=path))


def _process(
    slam: Slam,
    dataset: Dataset,
    folder: RunFolder,
    settings: RunSettings,
    watch: StageRecorder,
    progress: Progress,
) -> SlamResult:
    """Process the remaining frames, saving checkpoints on the way, and refine the map."""
    checkpoint = folder.load_checkpoint()
    start = 0
    if checkpoint is not None:
        slam.restore(checkpoint.arrays, checkpoint.values)
        start = checkpoint.next_frame
        _log.info("resumed %s at frame %d of %d", folder.path, start, len(dataset))
    saved_at, new_keyframes = time.monotonic(), 0
    frames = prefetched(dataset, range(start, len(dataset)), prepare=slam.prepare)
    for frame in progress(frames, len(dataset), start):
        with watch.timed("frame"):
            result = slam.process_frame(frame, may_map=not held_out(frame.index, settings))
        if result.lost:
            reason = result.tracking.reason if result.tracking else "the map has not begun"
            _log.warning("frame %d is lost: %s", frame.index, reason)
        due = time.monotonic() - saved_at > settings.checkpoint.every_s
        new_keyframes += result.keyframe
        if due or new_keyframes >= settings.checkpoint.every_keyframes:
            _save(slam, folder, frame.index + 1)
            saved_at, new_keyframes = time.monotonic(), 0
    keyframes, submaps = len(slam.result().keyframe_indices), len(slam.atlas)
    if not keyframes:
        raise DatasetError(f"no frame of {settings.dataset.path} could start a map; see the log")
    _save(slam, folder, len(dataset))
    _log.info(
        "Refining the map over %d keyframes in %s.",
        keyframes,
        "one submap" if submaps == 1 else f"{submaps} submaps",
    )
    return slam.finish()


def _save(slam: Slam, folder: RunFolder, next_frame: int) -> None:
    folder.save_checkpoint(next_frame, *slam.state())
    slam.atlas.checkpointed()


def _log_to(path: Path) -> None:
    handler = logging.FileHandler(path)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.getLogger("toolkit").addHandler(handler)
