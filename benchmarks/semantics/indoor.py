"""Classes from depth alone: the indoor segmenter on rooms and recordings it has not learned from.

    SEMSPLAT_DATA=DATA python -m benchmarks.semantics.indoor [--only 'office0: all views']

Accuracy and IoU count the cells of frames, of classes that are there.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.shared.recordings import opened
from benchmarks.shared.runner import Page
from benchmarks.shared.tables import Metrics, Rows, Table, Target, table_of, targets_of
from data_tools.training_rooms.rooms import FAMILIES, random_room
from data_tools.training_rooms.samples import CLASS_IDS
from data_tools.training_rooms.views import RenderedRoom
from toolkit.base.frame import Frame
from toolkit.semantics.segmenters.geometric import CLASS_NAMES, GeometricSegmenter
from toolkit.semantics.segmenters.geometric.surface_grid import SurfaceGrid, surface_grid
from toolkit.semantics.segmenters.indoor.classes import (
    INDOOR_CLASSES,
    INDOOR_GROUPS,
    INDOOR_KINDS,
)
from toolkit.semantics.segmenters.indoor.segmenter import IndoorSegmenter

Posed = tuple[Frame, NDArray[np.float64]]
# Cells of a view with depth, and log probabilities [N, C] of their classes.
Judge = Callable[[Posed], tuple[SurfaceGrid, NDArray[np.float32]]]

_SEED, _ROOMS, _VIEWS = 2_000_003, 25, 12
_SYNTHETIC = ("room-noise", "walk")
_EVERY = {"office0": 1, "room-noise": 6, "walk": 12}
_BINS = 10
_COLUMNS = (
    *("accuracy_percent", "miou_percent", "group_accuracy_percent", "group_miou_percent"),
    *("kind_accuracy_percent", "kind_miou_percent", "ece_percent"),
)
_RECALLS = ("sofa", "table", "chair", "screen", "plant", "cabinet", "door", "window", "blinds")

# Classes of Replica, whose names synthetic rooms use too, that are not `thing`.
_OF_REPLICA = {
    "floor": ("floor", "rug", "mat"),
    "wall": ("wall", "pillar", "panel", "switch", "wall-plug", "vent", "beam"),
    "ceiling": ("ceiling",), "door": ("door",), "window": ("window",),
    "blinds": ("blinds", "curtain"), "table": ("table", "table-runner"), "desk": ("desk",),
    "chair": ("chair", "stool", "bench", "beanbag"), "sofa": ("sofa",),
    "bed": ("bed", "comforter", "blanket"), "shelf": ("shelf", "rack"),
    "cabinet": ("cabinet", "base-cabinet", "wall-cabinet", "wardrobe", "nightstand", "tv-stand",
                "countertop"),
    "appliance": ("refrigerator", "microwave", "major-appliance", "small-appliance", "cooktop"),
    "sanitary": ("bathtub", "toilet", "sink", "shower-stall"), "lamp": ("lamp",),
    "screen": ("tv-screen", "monitor", "laptop"), "picture": ("picture", "clock"),
    "plant": ("indoor-plant", "plant-stand"), "cushion": ("cushion", "pillow"), "box": ("box",),
}  # fmt: skip
_GEOMETRIC = {"floor": "floor", "wall": "wall", "ceiling": "ceiling", "surface": "table"}


def measure(job: list[str], seed: int) -> Metrics:
    """Compare cells with the truth.

    Args:
        job: what is seen, and how it is judged: "one view", "all views" or "geometric".
    """
    source, way = job
    confusion = np.zeros((len(INDOOR_CLASSES), len(INDOOR_CLASSES)))
    sure = np.zeros((_BINS, 3))  # cells, probability, right ones
    times = []
    for views in _rooms(source, seed):
        judge = _judge(way)
        if way == "all views":
            for view in views:
                judge(view)
        for view in views:
            begin = time.perf_counter()
            grid, log_p = judge(view)
            times.append(time.perf_counter() - begin)
            _count(view[0], grid, log_p, confusion, sure)
    return {**_scores(confusion), "ece_percent": _ece(sure), "view_ms": 1e3 * np.median(times)}


def _judge(way: str) -> Judge:
    segmenter = GeometricSegmenter() if way == "geometric" else IndoorSegmenter()
    if isinstance(segmenter, IndoorSegmenter):
        return lambda view: segmenter.cells(view[0], None if way == "one view" else view[1])
    table = np.zeros(len(CLASS_NAMES) + 1, np.int64)
    for number, name in CLASS_NAMES.items():
        table[number] = INDOOR_CLASSES.index(_GEOMETRIC.get(name, "thing"))

    def judged(view: Posed) -> tuple[SurfaceGrid, NDArray[np.float32]]:
        grid = surface_grid(view[0].depth_m, view[0].camera)
        found = _at_cells(segmenter.segment(*view), grid)[grid.valid]
        certain = np.log(np.eye(len(INDOOR_CLASSES), dtype=np.float32) + 1e-9)
        return grid, certain[table[found]]

    return judged


def _rooms(source: str, seed: int) -> Iterator[list[Posed]]:
    """The views of each room of a source, with their labels in the order of the classes."""
    if source in FAMILIES:
        for number in range(_ROOMS):
            rng = np.random.default_rng([_SEED, seed, number])
            rendered = RenderedRoom(random_room(rng, source), CLASS_IDS)
            seen = [rendered.view(rng, 160, 120) for _ in range(_VIEWS)]
            grey = np.zeros((120, 160, 3), np.float32)
            yield [
                (Frame(k, 0.0, grey, v.depth_m, v.camera, v.labels), v.T_world_camera)
                for k, v in enumerate(seen)
                if v is not None
            ]
        return
    dataset = opened(source, seed)
    table = _relabelling(dataset.label_names or {})
    poses = dataset.ground_truth
    assert poses is not None
    frames: Iterable[Frame] = (dataset[k] for k in range(0, len(dataset), _EVERY[source]))
    yield [
        (replace(f, labels=table[f.labels]), poses.T_world_camera[f.index])
        for f in frames
        if f.labels is not None
    ]


def _relabelling(names: Mapping[int, str]) -> NDArray[np.int32]:
    known = {name: ours for ours, theirs in _OF_REPLICA.items() for name in theirs}
    table = np.zeros(max(names) + 1, np.int32)
    for number, name in names.items():
        table[number] = CLASS_IDS[known.get(name, "thing")]
    return table


def _at_cells(image: NDArray[np.int32], grid: SurfaceGrid) -> NDArray[np.int32]:
    """The pixel in the middle of each cell."""
    (height, width), start = grid.valid.shape, grid.block // 2
    return image[start :: grid.block, start :: grid.block][:height, :width]


def _count(
    frame: Frame,
    grid: SurfaceGrid,
    log_p: NDArray[np.float32],
    confusion: NDArray[np.float64],
    sure: NDArray[np.float64],
) -> None:
    assert frame.labels is not None
    true = _at_cells(frame.labels, grid)[grid.valid]
    known = true > 0
    true, log_p = true[known] - 1, log_p[known]
    found, p = log_p.argmax(axis=1), np.exp(log_p.max(axis=1))
    np.add.at(confusion, (true, found), 1.0)
    values = np.stack([np.ones_like(p), p, found == true], axis=1)
    np.add.at(sure, np.minimum((p * _BINS).astype(int), _BINS - 1), values)


def _ece(sure: NDArray[np.float64]) -> float:
    """Expected calibration error in percent."""
    return float(100.0 * np.abs(sure[:, 1] - sure[:, 2]).sum() / max(sure[:, 0].sum(), 1.0))


def _scores(confusion: NDArray[np.float64]) -> Metrics:
    found: Metrics = {}
    levels = {"": np.arange(len(INDOOR_CLASSES)), "group_": INDOOR_GROUPS, "kind_": INDOOR_KINDS}
    for level, numbers in levels.items():
        joined = np.zeros((numbers.max() + 1, numbers.max() + 1))
        np.add.at(joined, (numbers[:, None], numbers[None]), confusion)
        hit, there = joined.diagonal(), joined.sum(axis=1)
        union = joined.sum(axis=0) + there - hit
        found[f"{level}accuracy_percent"] = 100.0 * hit.sum() / joined.sum()
        found[f"{level}miou_percent"] = float(100.0 * np.mean((hit / union)[there > 0]))
    for name in _RECALLS:
        row = confusion[INDOOR_CLASSES.index(name)]
        recall = row[INDOOR_CLASSES.index(name)] / row.sum() if row.sum() else None
        found[f"recall_{name}_percent"] = None if recall is None else 100.0 * recall
    return found


def tables(rows: Rows) -> list[Table]:
    """What is right, by room and by class."""
    recalls = tuple(f"recall_{name}_percent" for name in _RECALLS)
    return [
        _part(rows, "unseen rooms", _COLUMNS, "Unseen rooms of each family, all views"),
        _part(rows, "office0", (*_COLUMNS, "view_ms"), "office0 of Replica"),
        _part(rows, "office0", recalls, "Recall at office0"),
        *(
            _part(rows, name, _COLUMNS, f"`make-room`, {name}: another style of rooms")
            for name in _SYNTHETIC
        ),
    ]


def _part(rows: Rows, part: str, columns: tuple[str, ...], title: str) -> Table:
    prefix = f"{part}: "
    chosen = {n.removeprefix(prefix): runs for n, runs in rows.items() if n.startswith(prefix)}
    return table_of(columns, chosen, title=title)


def targets(rows: Rows) -> list[Target]:
    """What labels without labels should reach."""
    office = "office0: all views"
    unseen = [f"unseen rooms: {family}" for family in FAMILIES]
    return targets_of(
        rows,
        at_least=(
            ("office0, cells in the right group in %", office, "group_accuracy_percent", 94),
            ("office0, mIoU of groups in %", office, "group_miou_percent", 50),
            ("office0, recall of sofa in %", office, "recall_sofa_percent", 85),
            ("office0, recall of table in %", office, "recall_table_percent", 65),
            ("office0, recall of chair in %", office, "recall_chair_percent", 35),
            *((f"{r}, accuracy in %", r, "accuracy_percent", 88) for r in unseen),
            *((f"{r}, mIoU in %", r, "miou_percent", 68) for r in unseen),
        ),
        at_most=[(f"{r}, calibration error in %", r, "ece_percent", 5) for r in (*unseen, office)],
    )


PAGE = Page(
    name="indoor",
    title="Classes from depth alone",
    description="The indoor segmenter, which has learned from other synthetic rooms, at true "
    "poses. mIoU: over the classes that are there. All views: the votes of all views of a room, "
    "as at the end of a run. geometric: `--segmenter.kind geometric`, each surface a table. "
    "Blinds of office0 are flat like its walls: 12 % of its labelled cells.",
    jobs={
        **{f"unseen rooms: {family}": [family, "all views"] for family in FAMILIES},
        **{f"office0: {way}": ["office0", way] for way in ("one view", "all views", "geometric")},
        **{
            f"{name}: {way}": [name, way]
            for name in _SYNTHETIC
            for way in ("one view", "all views", "geometric")
        },
    },
    measure=measure,
    tables=tables,
    targets=targets,
    measures=("toolkit/semantics/segmenters", "data_tools/training_rooms"),
)

if __name__ == "__main__":
    PAGE.main()
