"""What each channel and each family of rooms is worth: the indoor network trained without it.

SEMSPLAT_DATA=DATA python -m benchmarks.semantics.left_out
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.random import Generator
from torch import Tensor

from benchmarks.semantics.indoor import labelled_cells, labelled_views, scores
from benchmarks.shared.runner import WORK, Page
from benchmarks.shared.tables import Metrics, Rows, Table, table_of
from data_tools.train_segmenter import Training, confusion, export
from data_tools.training_rooms.rooms import FAMILIES
from data_tools.training_rooms.samples import CLASS_IDS, sample
from data_tools.training_rooms.views import training_views
from toolkit.io.atomic import replacing
from toolkit.semantics.options import GeometricOptions
from toolkit.semantics.segmenters.geometric.room import Room
from toolkit.semantics.segmenters.geometric.surface_grid import surface_grid
from toolkit.semantics.segmenters.indoor.classes import INDOOR_CLASSES
from toolkit.semantics.segmenters.indoor.network import IndoorWeights, load_weights
from toolkit.semantics.segmenters.indoor.segmenter import view_log_probabilities

# At a quarter of the cells, a step takes a quarter of the time.
_SIZE, _STEPS, _BATCH = (80, 60), 2500, 16
# Views of each family that are learned from, and that judge.
_VIEWS, _JUDGES, _SEED = 3000, 240, 3_000_003
_CHANNELS: dict[str, list[int]] = {
    "nothing": [],
    "height above the floor": [0],
    "angle to the vertical": [1],
    "angle to the ray": [2],
    "size of a cell": [3],
    "inverse depth in two windows": [4, 5],
}
# Convolutions that read the channels.
_READERS = ("stem.0.weight", "fine.0.0.weight")


def measure(job: list[str], seed: int) -> Metrics:
    """Train without a channel or a family, and judge the network."""
    _, name = job
    blank = _CHANNELS.get(name, [])
    pools = [_views(family, _VIEWS) for family in FAMILIES if family != name]
    rng = np.random.default_rng([_SEED, seed])
    training = Training(_STEPS, seed)
    for _ in range(_STEPS):
        channels, labels = _drawn(rng, pools)
        channels[:, blank] = 0
        training.learn(channels, labels)
    for reader in _READERS:
        training.average[reader][:, blank] = 0
    network = training.averaged()
    by_family = {f: confusion(network, _batches(*_views(f, _JUDGES))).numpy() for f in FAMILIES}
    together = scores(np.sum(list(by_family.values()), axis=0))
    metrics: Metrics = {key: together[key] for key in ("accuracy_percent", "miou_percent")}
    metrics |= {
        f"{f}_miou_percent": scores(matrix)["miou_percent"] for f, matrix in by_family.items()
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "weights.safetensors"
        export(training, path)
        return metrics | _at_office(load_weights(path), seed)


def _at_office(weights: IndoorWeights, seed: int) -> Metrics:
    """Groups of single views of office0."""
    matrix = np.zeros((len(INDOOR_CLASSES), len(INDOOR_CLASSES)))
    for frame, _ in next(labelled_views("office0", seed)):
        grid = surface_grid(frame.depth_m, frame.camera, _SIZE[0])
        room = Room(GeometricOptions().camera_height_m)
        view = room.update(grid, np.eye(4))
        log_p = view_log_probabilities(weights, view, room)[:, grid.valid].T
        true, log_p = labelled_cells(frame, grid, log_p)
        np.add.at(matrix, (true, log_p.argmax(axis=1)), 1.0)
    found = scores(matrix)
    wanted = ("group_accuracy_percent", "group_miou_percent")
    return {f"office0_{key}": found[key] for key in wanted}


def _views(family: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Channels and labels of views of a family, which are made when they are first needed."""
    stem = WORK / "left-out" / f"{family}-{count}"
    files = [stem.with_suffix(f".{part}.npy") for part in ("channels", "labels")]
    if not files[1].exists():
        rng = np.random.default_rng([_SEED, list(FAMILIES).index(family), count])
        views = training_views(rng, CLASS_IDS, _SIZE, 6, family)
        samples = [sample(rng, next(views)) for _ in range(count)]
        stem.parent.mkdir(parents=True, exist_ok=True)
        for file, values in zip(files, zip(*samples, strict=True), strict=True):
            with replacing(file) as partial, partial.open("wb") as out:
                np.save(out, np.stack(values))
    return np.load(files[0], mmap_mode="r"), np.load(files[1], mmap_mode="r")


def _batches(channels: np.ndarray, labels: np.ndarray) -> Iterator[tuple[Tensor, Tensor]]:
    for start in range(0, len(labels), _BATCH):
        part = slice(start, start + _BATCH)
        yield torch.from_numpy(channels[part].copy()), torch.from_numpy(labels[part].copy())


def _drawn(rng: Generator, pools: list[tuple[np.ndarray, np.ndarray]]) -> tuple[Tensor, Tensor]:
    """A batch of views of all families, half of them in a mirror."""
    chosen = [pools[k] for k in rng.integers(len(pools), size=_BATCH)]
    numbers = rng.integers(_VIEWS, size=_BATCH)
    turns = rng.integers(2, size=_BATCH) * 2 - 1
    picked = zip(chosen, numbers, turns, strict=True)
    pairs = [(c[n, ..., ::turn], labels[n, :, ::turn]) for (c, labels), n, turn in picked]
    channels, labels = (torch.from_numpy(np.stack(values)) for values in zip(*pairs, strict=True))
    return channels, labels


def tables(rows: Rows) -> list[Table]:
    """What is lost without each of them."""
    columns = (
        *("accuracy_percent", "miou_percent"),
        *("office0_group_accuracy_percent", "office0_group_miou_percent"),
    )
    families = {
        f: [
            {
                "with_percent": rows["without nothing"][0][f"{f}_miou_percent"],
                "without_percent": rows[f"without {f}"][0][f"{f}_miou_percent"],
            }
        ]
        for f in FAMILIES
        if f"without {f}" in rows and "without nothing" in rows
    }
    return [
        table_of(columns, rows, title="Unseen rooms of all families, and office0"),
        table_of(
            ("with_percent", "without_percent"),
            families,
            title="mIoU in unseen rooms of each family, if it is learned from and if not",
        ),
    ]


PAGE = Page(
    name="left-out",
    title="Channels and families of rooms, each left out once",
    description=f"Short trainings of the indoor network, of {_STEPS} steps of {_BATCH} views that "
    f"are drawn from {_VIEWS} of each family, with cells twice as "
    "large as usual. Single views. office0: groups, joined with the structure of the room.",
    jobs={f"without {name}": ["left out", name] for name in (*_CHANNELS, *FAMILIES)},
    measure=measure,
    tables=tables,
    measures=("toolkit/semantics/segmenters", "data_tools/training_rooms"),
)

if __name__ == "__main__":
    PAGE.main()
