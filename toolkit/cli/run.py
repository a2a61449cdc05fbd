"""`semsplat run`: track and map a data set, evaluate, leave a run folder."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from tqdm import tqdm

from toolkit.cli.arguments import parse_arguments
from toolkit.cli.run_results import held_out, write_results
from toolkit.cli.saved_map import begin_in_map, labeller_of, open_saved_map
from toolkit.closing.factory import ClosingContext, build_loop_closer
from toolkit.datasets.base import Dataset
from toolkit.datasets.prefetch import prefetched
from toolkit.datasets.registry import open_dataset
from toolkit.errors import DatasetError, SettingsError, ToolkitError
from toolkit.evaluation.timing import StageRecorder
from toolkit.loops.log import LoopLog
from toolkit.mapping.factory import build_mapper, build_semantic_mapping
from toolkit.registration.factory import build_placement
from toolkit.rendering import map_device
from toolkit.run_folder import RunFolder
from toolkit.semantics.factory import build_code
from toolkit.settings.files import dump, load
from toolkit.settings.run import RunSettings
from toolkit.slam import Slam
from toolkit.submaps.factory import build_atlas
from toolkit.tracking.factory import build_tracker
from toolkit.tracking.given import GivenPoses

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunProgram:
    """Track and map an RGB-D sequence."""

    out: Path
    """Run folder to write."""
    settings: Annotated[RunSettings, tyro.conf.arg(name="")] = field(default_factory=RunSettings)
    config: Path | None = None
    """YAML settings to start from; options on the command line win."""
    resume: bool = False
    """Go on from the last checkpoint of an interrupted run."""


def main(argv: Sequence[str]) -> int:
    """Run SLAM on a data set.

    Raises:
        ToolkitError: bad settings, data or output folder.
    """
    program = _parse(list(argv))
    path = _dataset_path(program)
    settings = _with_path(program.settings, path)
    dataset = open_dataset(settings.dataset.kind, path, settings.image_size, settings.max_frames)
    config = dump(settings)
    # Before a folder is made: it is of no use with another map.
    begun = program.resume and RunFolder(program.out).has_checkpoint
    saved = None if begun else open_saved_map(settings, dataset)
    if program.resume:
        folder = RunFolder.open(program.out)
        folder.check_config(config)
    else:
        folder = RunFolder.create(program.out, config)
    watch = StageRecorder()
    try:
        slam = build_slam(settings, dataset, watch, folder)
    except ToolkitError:
        if not program.resume:
            folder.discard()  # so that the same --out can be given again
        raise
    _log_to(folder.log)
    folder.check_taxonomy(slam.taxonomy)
    if saved is not None:
        begin_in_map(slam, saved)
        # What it began in is the run's own from here on, and need not be there to resume.
        _save(slam, folder, 0)
    _process(slam, dataset, folder, settings, watch)
    write_results(slam, dataset, folder, settings, watch)
    return 0


def build_slam(
    settings: RunSettings, dataset: Dataset, watch: StageRecorder, folder: RunFolder | None = None
) -> Slam:
    """The system that the settings describe.

    Args:
        folder: where submaps rest and loops are written down; None keeps all in memory.
    """
    labeller = labeller_of(settings, dataset)
    code = build_code(settings.semantics.code, labeller.taxonomy) if labeller else None
    # The papers' tracker compares pixels as they are drawn; with given poses none compares any.
    centred = settings.mapping.centred
    centred &= settings.poses == "slam" and settings.tracking.kind == "dense"
    mapper = build_mapper(
        settings.mapping.model_copy(update={"centred": centred}),
        np.random.default_rng(settings.seed),
        settings.backend,
        watch,
        build_semantic_mapping(settings.semantics, code, settings.seed),
        map_device(settings.device, settings.backend),
    )
    atlas = build_atlas(settings.submaps, mapper, labeller, folder.submaps if folder else None)
    if settings.poses == "slam":
        tracker = build_tracker(settings.tracking, settings.backend, watch, code, centred)
        closer = None
        if settings.loops.use:
            taxonomy = labeller.taxonomy if labeller else None
            context = ClosingContext(
                settings.seed, settings.backend, mapper.semantics, taxonomy, centred
            )
            log = LoopLog(folder.loops) if folder else None
            closer = build_loop_closer(settings.loops, context, log, watch)
        # The papers' tracker is there to be compared with.
        dense = settings.tracking.kind == "dense"
        placement = build_placement(settings.placement) if dense else None
        return Slam(tracker, mapper, watch, labeller, atlas, closer, settings.denoise, placement)
    if dataset.ground_truth is None:
        raise DatasetError(
            f"--poses given needs poses, and {settings.dataset.path} has none; use --poses slam"
        )
    poses = GivenPoses(dataset.ground_truth)
    return Slam(poses, mapper, watch, labeller, atlas, denoise=settings.denoise)


def _parse(argv: list[str]) -> RunProgram:
    start = RunSettings()
    if "--config" in argv[:-1]:
        start = load(Path(argv[argv.index("--config") + 1]))
    default = RunProgram(out=tyro.MISSING, settings=start)
    return parse_arguments(RunProgram, argv, "run", default=default)


def _dataset_path(program: RunProgram) -> Path:
    """Where the data set lies: a synthetic run without a path makes the default room."""
    settings = program.settings
    if settings.dataset.path is not None:
        return settings.dataset.path
    if settings.dataset.kind != "synthetic":
        raise SettingsError(f"--dataset.kind {settings.dataset.kind} needs --dataset.path DIR")
    from toolkit.cli.make_room import with_progress
    from toolkit.datasets.synthetic import RoomSettings, make_room

    room = program.out.with_name(program.out.name + "_room")
    if not program.resume and not (room / "traj.txt").exists():
        _log.info("making a synthetic room in %s", room)
        make_room(room, RoomSettings(seed=settings.seed), with_progress)
    return room


def _with_path(settings: RunSettings, path: Path) -> RunSettings:
    dataset = settings.dataset.model_copy(update={"path": path})
    return settings.model_copy(update={"dataset": dataset})


def _process(
    slam: Slam, dataset: Dataset, folder: RunFolder, settings: RunSettings, watch: StageRecorder
) -> None:
    """Feed the frames that are left, saving checkpoints on the way, and refine."""
    checkpoint = folder.load_checkpoint()
    start = 0
    if checkpoint is not None:
        slam.restore(checkpoint.arrays, checkpoint.values)
        start = checkpoint.next_frame
        _log.info("resumed %s at frame %d of %d", folder.path, start, len(dataset))
    saved_at, saved_keyframes = time.monotonic(), slam.keyframe_count
    frames = prefetched(dataset, range(start, len(dataset)), prepare=slam.prepare)
    for frame in _with_progress(frames, start, len(dataset)):
        with watch.timed("frame"):
            result = slam.process_frame(frame, may_map=not held_out(frame.index, settings))
        if result.lost:
            reason = result.tracking.reason if result.tracking else "the map has not begun"
            _log.warning("frame %d is lost: %s", frame.index, reason)
        due = time.monotonic() - saved_at > settings.checkpoint.every_s
        keyframes = slam.keyframe_count
        due |= keyframes - saved_keyframes >= settings.checkpoint.every_keyframes
        if due:
            _save(slam, folder, frame.index + 1)
            saved_at, saved_keyframes = time.monotonic(), keyframes
    if not slam.keyframe_count:
        raise DatasetError(f"no frame of {settings.dataset.path} could start a map; see the log")
    _save(slam, folder, len(dataset))
    _log.info(
        "refining the map over %d keyframes in %s",
        slam.keyframe_count,
        "one submap" if len(slam.atlas) == 1 else f"{len(slam.atlas)} submaps",
    )
    slam.finish()


def _save(slam: Slam, folder: RunFolder, next_frame: int) -> None:
    folder.save_checkpoint(next_frame, *slam.state())
    slam.atlas.checkpointed()


def _with_progress(frames: Iterator[Any], start: int, total: int) -> Iterator[Any]:
    return iter(tqdm(frames, initial=start, total=total, unit="frame", file=sys.stderr))


def _log_to(path: Path) -> None:
    handler = logging.FileHandler(path)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.getLogger("toolkit").addHandler(handler)
