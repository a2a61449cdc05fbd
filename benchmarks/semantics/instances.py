"""Instances against the truth: objects by connection, masks with faults, and geometric masks.

    SEMSPLAT_DATA=DATA python -m benchmarks.semantics.instances [--seeds 5]

All rows of a sequence see the same keyframes of one run; the map is the same.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.semantics.instance_masks import Faults, TrueMasks
from benchmarks.semantics.instance_quality import instance_scores
from benchmarks.shared.recordings import RECORDINGS, room
from benchmarks.shared.runner import Page
from benchmarks.shared.tables import MISSING, Metrics, Rows, Table, table_of
from toolkit.base.keyframe import Keyframe
from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.registry import open_dataset
from toolkit.runs.building import build_slam
from toolkit.runs.maps.map_files import splat_labels
from toolkit.runs.settings import RunSettings
from toolkit.scene.instances.finishing import finish_instances
from toolkit.scene.instances.geometric import GeometricMasks
from toolkit.scene.instances.masks import InstanceMasks, MaskSource
from toolkit.scene.instances.options import InstanceOptions
from toolkit.scene.instances.records import KeyframeMasks
from toolkit.scene.instances.result import InstanceMap
from toolkit.scene.instances.tracking import InstanceTracker
from toolkit.scene.instances.voting import GaussianVotes, MaskedKeyframe
from toolkit.scene.instances.voxels import VoxelVotes, sampled, sampling_step
from toolkit.scene.query import LabelledMap
from toolkit.semantics.options import ObjectOptions
from toolkit.slam.refinement.fusion import FusedMap
from toolkit.slam.result import SlamResult
from toolkit.slam.system import Slam

# Name of a sequence: its dataset, number of frames and image size.
SEQUENCES = ("room", "office0", "ring")
ROOMS = {"room": "room-instances", "ring": "ring-small"}
# Number of seeds of the sequences that are not measured with all of them.
FEWER_SEEDS = {"office0": 1, "ring": 1}
FAULTS = {
    "true masks": Faults(),
    "20 % dropped": Faults(dropped=0.2),
    "15 % merged": Faults(merged=0.15),
    "15 % halved": Faults(halved=0.15),
    "eroded by 2 pixels": Faults(eroded=2),
    "all faults": Faults(0.2, 0.15, 0.15, 2),
    "all faults, embeddings": Faults(0.2, 0.15, 0.15, 2, embedded=0.5),
}
# Minimum number of sampled pixels of a true object with a mask, in a keyframe that shows it.
_MIN_SHOWN = 12
COMPONENTS, GEOMETRIC, UNLABELLED = "components of classes", "geometric", "geometric, no classes"
ERRORS = ("split", "merged", "switches")
COLUMNS = ("pq", "ap25", "ap50", "predicted", "true", *ERRORS, "ms_per_keyframe")
DESCRIPTION = """\
Every Gaussian of the map has the instance that most true instance images show at its place; its
predicted object is compared with that. Scores do not depend on classes. "Components of classes"
are the objects of a map without instances: DBSCAN on the Gaussians of each class. Other rows use
true masks whose numbers restart in every frame, with the faults that the row names, or masks from
depth, colour and class labels. Split: true objects of which several predicted ones show a part;
merged: predicted objects with most of several true ones; switches: how often the object of the
masks of a true object changes from one keyframe that shows it to the next one, after the end of the
run has joined objects. The time is that of association per
keyframe (of the processor), without the source of the masks.

room is a synthetic room of 90 frames with sensor noise (160x120) with as many seeds as listed,
office0 51 views of Replica (300x170, given poses), and ring four rooms with a loop (450 frames,
160x120, sensor noise; one seed). A seed changes the furniture, the camera's sway, the noise and
the faults of the masks."""


def tables(found: Rows) -> list[Table]:
    """Quality, and its range over the seeds."""
    rows = _rows(found)
    several = {name: runs for name, runs in rows.items() if len(runs) > 1}
    return [table_of(COLUMNS, rows), _ranges(several)]


def _rows(found: Rows) -> Rows:
    """The metrics of each row of each sequence, of the seeds with which it was measured."""
    return {
        f"{name}, {variant}": [run[variant] for run in runs if run]
        for name, runs in found.items()
        for variant in (runs[0] if runs else ())
    }


def _ranges(rows: Rows) -> Table:
    """The lowest and the highest value over the seeds."""
    columns = ("pq", "ap50", *ERRORS)

    def cell(runs: list[Metrics], column: str) -> str:
        values = [run[column] for run in runs if run.get(column) is not None]
        return f"{min(values):.4g} to {max(values):.4g}" if values else MISSING

    lines = tuple((n, *(cell(list(runs), c) for c in columns)) for n, runs in rows.items())
    return Table(("", *columns), lines, "Lowest to highest value over the seeds")


def measure(name: str, seed: int) -> Metrics:
    """Metrics of all rows of a sequence, by row; none for a seed beyond those of the sequence."""
    if seed >= FEWER_SEEDS.get(name, seed + 1):
        return {}
    settings, folder = _settings(name, seed)
    assert settings.dataset.path is not None
    dataset = open_dataset(settings.dataset.kind, settings.dataset.path, settings.image_size)
    slam = build_slam(dataset, settings)
    assert slam.taxonomy is not None
    names = dict(enumerate(slam.taxonomy.classes, start=1))
    truth = TrueMasks(folder, Faults())
    sources: dict[str, MaskSource] = {
        **{row: TrueMasks(folder, faults, seed) for row, faults in FAULTS.items()},
        GEOMETRIC: GeometricMasks(),
        UNLABELLED: GeometricMasks("ignored"),
    }
    options = InstanceOptions()
    trackers = {
        row: InstanceTracker(options, _Timed(source), None if row == UNLABELLED else names)
        for row, source in sources.items()
    }
    spent = dict.fromkeys(trackers, 0.0)
    shown: dict[int, NDArray[np.int32]] = {}
    for index in range(len(dataset)):
        slam.process_frame(dataset[index])
        for keyframe in slam.atlas.keyframes[-1:]:
            step = sampling_step(keyframe.camera.width)
            shown[keyframe.index] = sampled(truth.truth(keyframe), step)
        for row, tracker in trackers.items():
            begin = time.process_time()
            tracker.update(slam.atlas.active, slam.atlas.keyframes)
            spent[row] += time.process_time() - begin
    result = slam.finish()
    assert isinstance(result.map, FusedMap)
    true = _true_instances(slam, result.map, truth)
    scored = {COMPONENTS: _scores(_components(result), true) | {"switches": None}}
    for row, tracker in trackers.items():
        source = tracker.source
        assert isinstance(source, _Timed)
        keyframes = max(len(tracker.records), 1)
        instances = finish_instances(tracker, slam.atlas, [result.map])
        scored[row] = _scores(_joined(instances, result.map), true)
        scored[row]["switches"] = _switches(tracker, shown)
        scored[row]["ms_per_keyframe"] = 1000.0 * (spent[row] - source.spent_s) / keyframes
    return scored


class _Timed:
    """A source of masks that measures its time."""

    def __init__(self, source: MaskSource) -> None:
        self._source, self.spent_s = source, 0.0

    def masks(self, keyframe: Keyframe) -> InstanceMasks | None:
        """The masks of the source."""
        begin = time.process_time()
        masks = self._source.masks(keyframe)
        self.spent_s += time.process_time() - begin
        return masks


def _settings(name: str, seed: int) -> tuple[RunSettings, Path]:
    """Settings of a sequence, and the folder of its true instances."""
    if name in RECORDINGS:
        path = RECORDINGS[name].path
        dataset = DatasetOptions(kind="replica", path=path)
        settings = RunSettings(dataset=dataset, image_size=(300, 170), poses="given")
        return settings, path / "instances"
    path = room(ROOMS[name], seed)
    dataset = DatasetOptions(kind="synthetic", path=path)
    return RunSettings(dataset=dataset, seed=seed), path / "instances"


def _true_instances(slam: Slam, fused: FusedMap, truth: TrueMasks) -> NDArray[np.int32]:
    """The true instance [N] of every Gaussian of the map, 0 for none."""
    found = []
    for number in fused.numbers:
        submap = slam.atlas.submap(number)
        means = fused.part(number).means.double().numpy()
        images = [truth.truth(keyframe) for keyframe in submap.keyframes]
        largest = max(int(image.max()) for image in images)
        votes = GaussianVotes(means, VoxelVotes(1.0), largest)
        for keyframe, image in zip(submap.keyframes, images, strict=True):
            step = sampling_step(keyframe.camera.width)
            numbers = np.arange(1, largest + 1, dtype=np.int32)
            record = KeyframeMasks.of(keyframe.index, number, numbers, sampled(image, step))
            pose = submap.T_world_camera(keyframe)
            votes.add(MaskedKeyframe(keyframe, pose, record, numbers))
        found.append(votes.winners(fill=False))
    return np.concatenate(found)


def _switches(tracker: InstanceTracker, shown: Mapping[int, NDArray[np.int32]]) -> int:
    """Number of times that the object of the masks of a true object changes between keyframes.

    Args:
        tracker: after the end of the run.
        shown: true instances of the sampled pixels of each keyframe.
    """
    table, seen = tracker.table(), dict[int, list[int]]()
    for record in tracker.records:
        found = np.concatenate([[0], table[record.objects]])[record.ids]
        true = shown[record.index]
        for number in np.unique(true[true > 0]):
            own = found[true == number]
            own = own[own > 0]
            if len(own) >= _MIN_SHOWN:
                seen.setdefault(int(number), []).append(int(np.bincount(own).argmax()))
    return sum(a != b for objects in seen.values() for a, b in pairwise(objects))


def _components(result: SlamResult) -> NDArray[np.int32]:
    """Objects [N] by connection of the Gaussians of each class, 0 for none."""
    gaussians = result.gaussians
    decoding = result.semantics.decode_gaussians(gaussians.features)
    labels = splat_labels(decoding, 0.0)
    assert result.taxonomy is not None
    map_ = LabelledMap(gaussians.means.double().numpy(), labels, result.taxonomy)
    found = np.zeros(len(gaussians), np.int32)
    objects = map_.objects(None, None, ObjectOptions(min_gaussians=20))
    for number, one in enumerate(objects, start=1):
        found[one.index] = number
    return found


def _joined(instances: InstanceMap, fused: FusedMap) -> NDArray[np.int32]:
    return np.concatenate([instances.ids[number] for number in fused.numbers])


def _scores(predicted: NDArray[np.int32], truth: NDArray[np.int32]) -> Metrics:
    return {
        name: 100.0 * value if isinstance(value, float) else value
        for name, value in asdict(instance_scores(predicted, truth)).items()
    }


PAGE = Page(
    "instances",
    "Instances",
    DESCRIPTION,
    {name: name for name in SEQUENCES},
    measure,
    tables,
    seeds=5,
)

if __name__ == "__main__":
    PAGE.main()
