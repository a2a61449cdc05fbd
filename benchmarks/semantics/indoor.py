"""Classes from depth alone: the indoor segmenter on rooms and recordings it has not learned from.

    SEMSPLAT_DATA=DATA python -m benchmarks.semantics.indoor [--only 'office0: all views']

Accuracy and IoU count the cells of frames, of classes that are there.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.semantics.hard_views import HARD_VIEWS, Posed
from benchmarks.shared.indoor_labels import relabelling
from benchmarks.shared.recordings import opened
from benchmarks.shared.runner import Page
from benchmarks.shared.tables import Metrics, Rows, Table, Target, table_of, targets_of
from data_tools.training_rooms.rooms import FAMILIES, random_room
from data_tools.training_rooms.samples import CLASS_IDS
from data_tools.training_rooms.views import RenderedRoom
from toolkit.base.frame import Frame
from toolkit.semantics.segmenters.geometric import CLASS_NAMES, GeometricSegmenter
from toolkit.semantics.segmenters.geometric.surface_grid import SurfaceGrid, surface_grid
from toolkit.semantics.segmenters.head_training import score_head, train_head
from toolkit.semantics.segmenters.indoor.classes import (
    INDOOR_CLASSES,
    INDOOR_GROUPS,
    INDOOR_KINDS,
    INDOOR_TREE,
    OTHER_FURNITURE,
)
from toolkit.semantics.segmenters.indoor.encoder import IndoorEncoder
from toolkit.semantics.segmenters.indoor.segmenter import IndoorSegmenter

# Cells of a view with depth, and log probabilities [N, C] of their classes.
Judge = Callable[[Posed], tuple[SurfaceGrid, NDArray[np.float32]]]

_SEED, _ROOMS, _VIEWS = 2_000_003, 25, 12
_SYNTHETIC = ("room-noise", "walk")
_EVERY = {"office0": 1, "room-noise": 6, "walk": 12}
_BINS = 10
# Real recordings with points named by hand, and the interval of the frames that vote. Where one
# cannot tell, or paper lies on a table, several groups are right.
_REAL = {"redkitchen-native": 2, "hololens": 3, "fr1_rpy": 1}
_POINTS = Path(__file__).parents[1] / "data" / "labelled_points.json"
_GROUPS = tuple(g for groups in INDOOR_TREE.values() for g in groups if g != OTHER_FURNITURE)
POINTS_TITLE, HEAD_TITLE = "Points of real recordings named by hand", "A head of own classes"
# Labelled frames that a head learns from.
_SHOWN = 10
_COLUMNS = (
    *("accuracy_percent", "miou_percent", "group_accuracy_percent", "group_miou_percent"),
    *("kind_accuracy_percent", "kind_miou_percent", "ece_percent"),
)
_RECALLS = ("sofa", "table", "chair", "screen", "plant", "cabinet", "door", "window", "blinds")

_GEOMETRIC = {"floor": "floor", "wall": "wall", "ceiling": "ceiling", "surface": "table"}


def measure(job: list[str], seed: int) -> Metrics:
    """Compare cells with the truth.

    Args:
        job: what is seen, and how it is judged: "one view", "all views" or "geometric".
    """
    source, way = job
    if way == "head":
        return _own_classes(source, seed)
    if way in HARD_VIEWS:
        return _answers([HARD_VIEWS[way](*view) for view in next(labelled_views(source, seed))])
    if source in _REAL:
        return _at_points(source, way, seed)
    confusion = np.zeros((len(INDOOR_CLASSES), len(INDOOR_CLASSES)))
    sure = np.zeros((_BINS, 3))  # cells, probability, right ones
    times = []
    for views in labelled_views(source, seed):
        judge = _judge(way)
        if way == "all views":
            for view in views:
                judge(view)
        for view in views:
            begin = time.perf_counter()
            grid, log_p = judge(view)
            times.append(time.perf_counter() - begin)
            true, log_p = labelled_cells(view[0], grid, log_p)
            np.add.at(confusion, (true, log_p.argmax(axis=1)), 1.0)
            _count_sure(sure, true, log_p)
    return {**scores(confusion), "ece_percent": _ece(sure), "view_ms": 1e3 * np.median(times)}


def _at_points(source: str, way: str, seed: int) -> Metrics:
    """Compare the groups of points with those that a person has named, one or several of them."""
    dataset, judge = opened(source, seed), _judge(way)
    truth = dataset.ground_truth
    assert truth is not None

    def seen(number: int) -> tuple[SurfaceGrid, NDArray[np.float32]]:
        return judge((dataset[number], truth.T_world_camera[number]))

    for number in range(0, len(dataset), _REAL[source]) if way == "all views" else ():
        seen(number)
    right: list[bool] = []
    certain: list[bool] = []
    for number, points in json.loads(_POINTS.read_text())[source].items():
        grid, log_p = seen(int(number))
        groups = np.full(grid.valid.shape, -1)
        groups[grid.valid] = INDOOR_GROUPS[log_p.argmax(axis=1)]
        for x, y, *names in points:
            found = groups[y // grid.block, x // grid.block]
            right.append(found >= 0 and _GROUPS[found] in names)
            certain += right[-1:] if len(names) == 1 else []
    return {
        "points": len(right),
        "right_percent": 100.0 * float(np.mean(right)),
        "clear_points": len(certain),
        "clear_right_percent": 100.0 * float(np.mean(certain)),
    }


def _own_classes(source: str, seed: int) -> Metrics:
    """Train a head on the labels of some frames, and compare it with those of all others."""
    dataset, encoder = opened(source, seed), IndoorEncoder()
    names = dataset.label_names or {}
    shown = range(0, len(dataset), len(dataset) // _SHOWN)[:_SHOWN]
    generator = np.random.default_rng(seed)
    head = train_head(encoder, (dataset[k] for k in shown), names, generator)
    others = (dataset[k] for k in range(len(dataset)) if k not in shown)
    score = score_head(encoder, head, others, names)
    return {
        "classes": len(head.class_names),
        "accuracy_percent": 100.0 * score.accuracy,
        "miou_percent": 100.0 * score.mean_iou,
    }


def _answers(views: list[Posed]) -> Metrics:
    """What the segmenter says of single views: of how many cells it is sure, and is right."""
    segmenter, void, kinds, groups = IndoorSegmenter(), 0, np.zeros(3), np.zeros(2)
    cells, probability = 0, 0.0
    for frame, _ in views:
        grid, log_p = segmenter.cells(frame)
        found = _at_cells(segmenter.segment(frame), grid)[grid.valid]
        assert frame.labels is not None
        true = _at_cells(frame.labels, grid)[grid.valid]
        cells, void = cells + len(found), void + int((found == 0).sum())
        probability += float(np.exp(log_p.max(axis=1)).sum())
        named = (found > 0) & (found <= len(INDOOR_CLASSES))
        kinds += np.bincount(INDOOR_KINDS[found[named] - 1], minlength=3)
        named &= true > 0
        right = INDOOR_GROUPS[found[named] - 1] == INDOOR_GROUPS[true[named] - 1]
        groups += right.sum(), len(right)
    other = cells - void - kinds.sum()
    shares = {"void": void, "other_furniture": other, "structure": kinds[0]}
    shares |= {"furniture": kinds[1], "object": kinds[2]}
    return {
        **{f"{name}_percent": 100.0 * value / max(cells, 1) for name, value in shares.items()},
        "right_group_percent": 100.0 * groups[0] / groups[1] if groups[1] else None,
        "probability_percent": 100.0 * probability / max(cells, 1),
    }


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


def labelled_views(source: str, seed: int) -> Iterator[list[Posed]]:
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
    table = relabelling(dataset.label_names or {})
    poses = dataset.ground_truth
    assert poses is not None
    frames: Iterable[Frame] = (dataset[k] for k in range(0, len(dataset), _EVERY[source]))
    yield [
        (replace(f, labels=table[f.labels]), poses.T_world_camera[f.index])
        for f in frames
        if f.labels is not None
    ]


def _at_cells(image: NDArray[np.int32], grid: SurfaceGrid) -> NDArray[np.int32]:
    """The pixel in the middle of each cell."""
    (height, width), start = grid.valid.shape, grid.block // 2
    return image[start :: grid.block, start :: grid.block][:height, :width]


def labelled_cells(
    frame: Frame, grid: SurfaceGrid, log_p: NDArray[np.float32]
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Of cells with a label, the index [N] of its class and log probabilities [N, C]."""
    assert frame.labels is not None
    true = _at_cells(frame.labels, grid)[grid.valid]
    known = true > 0
    return true[known] - 1, log_p[known]


def _count_sure(
    sure: NDArray[np.float64], true: NDArray[np.int32], log_p: NDArray[np.float32]
) -> None:
    """Add cells to bins of the probability of the likeliest class."""
    p, right = np.exp(log_p.max(axis=1)), log_p.argmax(axis=1) == true
    values = np.stack([np.ones_like(p), p, right], axis=1)
    np.add.at(sure, np.minimum((p * _BINS).astype(int), _BINS - 1), values)


def _ece(sure: NDArray[np.float64]) -> float:
    """Expected calibration error in percent."""
    return float(100.0 * np.abs(sure[:, 1] - sure[:, 2]).sum() / max(sure[:, 0].sum(), 1.0))


def scores(confusion: NDArray) -> Metrics:
    """Accuracy and mIoU of classes, groups and kinds, and recalls, of a confusion matrix."""
    found: Metrics = {}
    levels = {"": np.arange(len(INDOOR_CLASSES)), "group_": INDOOR_GROUPS, "kind_": INDOOR_KINDS}
    for level, numbers in levels.items():
        joined = np.zeros((numbers.max() + 1, numbers.max() + 1))
        np.add.at(joined, (numbers[:, None], numbers[None]), confusion)
        hit, there = joined.diagonal(), joined.sum(axis=1)
        union = joined.sum(axis=0) + there - hit
        found[f"{level}accuracy_percent"] = 100.0 * hit.sum() / joined.sum()
        found[f"{level}miou_percent"] = float(
            100.0 * np.mean((hit / np.maximum(union, 1))[there > 0])
        )
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
        _part(
            rows,
            "real",
            ("points", "right_percent", "clear_points", "clear_right_percent"),
            POINTS_TITLE,
        ),
        _part(
            rows,
            "a head",
            ("classes", "accuracy_percent", "miou_percent"),
            HEAD_TITLE,
        ),
        _part(
            rows,
            "hard inputs",
            (
                *("void_percent", "other_furniture_percent", "structure_percent"),
                *("furniture_percent", "object_percent", "right_group_percent"),
                "probability_percent",
            ),
            "Views of office0, one by one, as other cameras or careless users give them: what "
            "their cells are called; of those named, the right groups; mean probability",
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
    real = [f"real: {name}, all views" for name in _REAL]
    return targets_of(
        rows,
        at_least=(
            ("office0, cells in the right group in %", office, "group_accuracy_percent", 94),
            ("office0, mIoU of groups in %", office, "group_miou_percent", 50),
            ("office0, recall of sofa in %", office, "recall_sofa_percent", 85),
            ("office0, recall of table in %", office, "recall_table_percent", 65),
            ("office0, recall of chair in %", office, "recall_chair_percent", 35),
            *((f"{r}, points right in %", r, "right_percent", 78) for r in real),
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
    "Blinds of office0 are flat like its walls: 12 % of its labelled cells. Points named by hand: "
    "their groups; clear ones have one name. The head: `train-head` on 10 labelled frames, and "
    "the pixels of all other frames.",
    jobs={
        **{f"unseen rooms: {family}": [family, "all views"] for family in FAMILIES},
        **{f"office0: {way}": ["office0", way] for way in ("one view", "all views", "geometric")},
        **{
            f"{name}: {way}": [name, way]
            for name in _SYNTHETIC
            for way in ("one view", "all views", "geometric")
        },
        **{
            f"real: {name}, {way}": [name, way]
            for name in _REAL
            for way in ("one view", "all views", "geometric")
        },
        "a head: office0": ["office0", "head"],
        **{f"hard inputs: {way}": ["office0", way] for way in HARD_VIEWS},
    },
    measure=measure,
    tables=tables,
    targets=targets,
    measures=("toolkit/semantics/segmenters", "data_tools/training_rooms"),
)

if __name__ == "__main__":
    PAGE.main()
