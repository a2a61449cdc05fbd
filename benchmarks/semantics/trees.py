"""What class trees are worth: their widths, and maps with each tree and code.

python -m benchmarks.semantics.trees widths         seconds
python -m benchmarks.semantics.trees many-classes   a room with 300 classes
python -m benchmarks.semantics.trees room           the table H-IX
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks.shared.recordings import opened, room, sequence_arguments
from benchmarks.shared.runner import Options, Page
from benchmarks.shared.runs import finished_run
from benchmarks.shared.tables import Metrics, Rows, Table, Target, median_of, table_of
from toolkit.base.geometry import se3
from toolkit.runs.evaluation.segmentation import class_iou, confusion
from toolkit.runs.maps.finished import FinishedRun, load_run
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_building.builder import BuildOptions, build_taxonomy
from toolkit.semantics.taxonomy_building.measured_shapes import ScanShapes, labelled_scan
from toolkit.semantics.taxonomy_building.rules import RuleGrouper
from toolkit.semantics.taxonomy_building.vocabulary import built_in
from toolkit.semantics.taxonomy_parsing import folded
from toolkit.semantics.trees import shipped_taxonomy
from toolkit.splatting.rendering import RenderOptions, backend, render_surface

PageName = Literal["widths", "many-classes", "room"]
Job = dict[str, str]
DATA = Path(__file__).parents[1] / "data"
_WIDTHS = ("classes", "widths", "one-hot", "binary", "build_s")
_QUALITY = ("trajectory.ate_rmse_cm", "depth.mapped.l1_cm", "images.mapped.psnr_db")
_MANY = (
    *("channels", "memory.map_mb", "memory.peak_mb", "semantics.mapped.miou_percent"),
    *("semantics.unseen.miou_percent", "semantics.mapped.miou_subset_percent"),
    *("semantics.unseen.miou_subset_percent", "semantics.mapped.level_0.miou_percent"),
    *("semantics.unseen.level_0.miou_percent", "images.mapped.psnr_db", "images.unseen.psnr_db"),
    *("time.mapping_ms_per_frame", "time.refinement_ms_per_frame", "map.gaussians"),
)
_KIN_LEVEL = 2
_TREES_OF_ROOM = ("ours", "meaning", "shape", "both", "random", "alphabetical")
_QUESTIONS = """\
All trees are asked the same questions on held-out views (`--hold-out 5`): the class of each pixel
decides, and a coarse query is a node of one tree, whichever the map has: mIoU in percent. "kin" is
the share of wrong pixels whose class belongs to the right group of that tree's third level."""


def class_lists() -> dict[str, list[str]]:
    """Names by list, in the order of their ids or of the alphabet."""
    known = ("replica", "nyu40", "scannet20")
    lists = {name: list(shipped_taxonomy(name).classes) for name in known}
    for path in sorted(DATA.glob("objects_*.txt")):
        lists[path.stem] = path.read_text(encoding="utf-8").splitlines()
    names = lists["objects_550"]
    others = {folded(name) for name in names}
    words = [entry.word for entry in built_in() if folded(entry.word) not in others]
    places = np.linspace(0, len(words) - 1, 1000 - len(names)).astype(int)
    return lists | {"objects_1000": [*names, *(words[place] for place in places)]}


def channels(tree: Taxonomy, code: str) -> int:
    """Number of semantic channels of a code."""
    widths = tree.level_widths
    binary = sum((width - 1).bit_length() for width in widths)
    known = {"none": 0, "flat": len(tree), "one-hot": sum(widths), "binary": binary, "colour": 3}
    return known[code]


def measure_widths(job: Job, _seed: int) -> Metrics:
    """Channels of the tree of a list."""
    begin, names = time.perf_counter(), class_lists()[job["list"]]
    tree = build_taxonomy(names, RuleGrouper(), options=BuildOptions(name=job["list"]))
    return {
        "classes": len(tree),
        "widths": " + ".join(map(str, tree.level_widths)),
        **{code: channels(tree, code) for code in ("one-hot", "binary")},
        "build_s": time.perf_counter() - begin,
    }


@cache
def trees(page: PageName) -> dict[str, Taxonomy]:
    """The trees of a page by name; coarse queries are nodes of the first one."""
    if page == "many-classes":
        rules = Taxonomy.load(room("collection") / "taxonomy.yaml")
        flat = Taxonomy.flat(rules.classes)
        return {"rules": rules, "random": random_taxonomy(rules), "flat": flat}
    ours, grouper = shipped_taxonomy("replica"), RuleGrouper()
    classes, shapes = ours.classes, _shapes_of_room()
    meaning = BuildOptions(aspects=("size", "function", "function", "function"))
    shape = BuildOptions(aspects=("geometry",) * 4)
    both = build_taxonomy(classes, grouper, shapes)
    return {
        "ours": ours,
        "meaning": build_taxonomy(classes, grouper, options=meaning),
        "shape": build_taxonomy(classes, grouper, shapes, shape),
        "both": both,
        "random": random_taxonomy(both),
        "alphabetical": alphabetical_taxonomy(both),
    }


def random_taxonomy(like: Taxonomy, seed: int = 0) -> Taxonomy:
    """A tree of the same structure and class ids, with randomly assigned classes."""
    order = np.random.default_rng(seed).permutation(len(like))
    return _filled(like, [like.classes[i] for i in order], "random")


def alphabetical_taxonomy(like: Taxonomy) -> Taxonomy:
    """A tree of the same structure and class ids, with classes in alphabetical order."""
    return _filled(like, sorted(like.classes, key=str.casefold), "alphabetical")


def _filled(like: Taxonomy, classes: Sequence[str], kind: str) -> Taxonomy:
    """The tree with the leaves renamed in order and numbered groups."""
    remaining = iter(classes)
    names: dict[tuple[str, ...], str] = {}
    root: dict[str, Any] = {}
    for number, node in enumerate(like.nodes):
        names[node.path] = next(remaining) if node.leaf else f"group {number}"
        branch = root
        for level in range(node.level):
            branch = branch[names[node.path[: level + 1]]]
        branch[names[node.path]] = {}
    return Taxonomy(root, like.levels, like.classes, f"{kind} {like.name}")


def _shapes_of_room() -> ScanShapes:
    """Shapes measured in the labelled points of every sixth frame of the room."""
    dataset = opened("room")
    truth, names = dataset.ground_truth, dataset.label_names
    assert truth is not None and names is not None
    frames = [dataset[index] for index in range(0, len(dataset), 6)]
    posed = [(frame, truth.at(frame.timestamp_s)) for frame in frames]
    return ScanShapes([labelled_scan([(f, T) for f, T in posed if T is not None], names)])


def measure_map(job: Job, seed: int) -> Metrics:
    """Metrics of a run with a tree and a code, and its answers on held-out views."""
    page: PageName = "room" if job["sequence"] == "room" else "many-classes"
    made = trees(page)
    tree, code = made[job["tree"]], job["code"]
    words = [*sequence_arguments(job["sequence"]), *job["options"].split(), "--hold-out", "5"]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "tree.yaml"
        tree.save(file)
        words += ["--semantics.code.kind", code, "--semantics.taxonomy", str(file)]
        with finished_run(words, seed) as (metrics, run):
            metrics |= {"channels": channels(tree, code)}
            metrics |= {"widths": " + ".join(map(str, tree.level_widths))}
            first = next(iter(made.values()))
            return metrics | (answers(load_run(run.path), first) if code != "none" else {})


def answers(run: FinishedRun, ours: Taxonomy) -> Metrics:
    """mIoU at each level of a tree, and how many wrong pixels are kin."""
    assert run.taxonomy is not None
    dataset = run.open_dataset()
    names = dataset.label_names
    assert names is not None
    truth_to_ours = ours.relabelling(names)
    own_to_ours = ours.relabelling(dict(enumerate(run.taxonomy.classes, start=1)))
    leaves = np.zeros((len(ours) + 1,) * 2, np.int64)
    for view in run.tracked:
        frame = dataset[view.index]
        if not view.held_out or frame.labels is None:
            continue
        T_camera_map = se3.inverse(view.T_map_camera)
        options = RenderOptions(features=True)
        drawn = render_surface(backend("auto"), run.gaussians, frame.camera, T_camera_map, options)
        decoded = run.semantics.decode_view(drawn).class_ids.reshape(frame.labels.shape)
        leaves += confusion(truth_to_ours[frame.labels], own_to_ours[decoded], len(ours))
    groups = [_grouping(ours, level) for level in range(ours.depth)]
    found: Metrics = {f"query {n}": _miou_percent(leaves, g) for n, g in enumerate(groups)}
    wrong = leaves[1:, 1:] - np.diag(np.diag(leaves)[1:])
    kin = groups[_KIN_LEVEL][1:]
    right = wrong[kin[:, None] == kin[None]].sum()
    return found | {"kin": 100.0 * float(right / max(wrong.sum(), 1))}


def _grouping(taxonomy: Taxonomy, level: int) -> NDArray[np.int64]:
    """The number [C + 1] of each class's node at a level, from 1 on; 0 is void."""
    _, place = np.unique(taxonomy.node_ids[:, level], return_inverse=True)
    return np.concatenate([[0], 1 + place])


def _miou_percent(leaves: NDArray[np.int64], group: NDArray[np.int64]) -> float:
    """Mean IoU of the groups that the truth has, from the confusion of classes."""
    count = int(group.max()) + 1
    coarse = np.zeros((count, count), np.int64)
    np.add.at(coarse, (group[:, None], group[None, :]), leaves)
    present = coarse.sum(axis=1) > 0
    present[0] = False
    return 100.0 * float(np.mean(class_iou(coarse)[present]))


def many_targets(rows: Rows) -> list[Target]:
    """The claim: far fewer channels than flat, hardly less mIoU."""
    median, found = median_of(rows), []
    for row, most in (("rules, one-hot", 1.0), ("rules, binary", 2.0)):
        for views in ("mapped", "unseen"):
            flat, own = (median(r, f"semantics.{views}.miou_percent") for r in ("flat", row))
            loss = None if flat is None or own is None else flat - own
            found.append(Target(f"{row} below flat, {views}, points of mIoU", loss, at_most=most))
        flat_mb, mb = (median(r, "memory.map_mb") for r in ("flat", row))
        share = None if flat_mb is None or mb is None else mb / flat_mb
        found.append(Target(f"{row}, size of the map of flat's", share, at_most=0.35))
    return found


def _jobs(sequence: str, options: str, rows: Mapping[str, Sequence[str]]) -> dict[str, Job]:
    return {
        name: {"sequence": sequence, "options": options, "tree": tree, "code": code}
        for name, (tree, code) in rows.items()
    }


def _questions(rows: Rows) -> Table:
    columns = (*(f"query {level}" for level in range(5)), "kin", "widths")
    asked = {name: runs for name, runs in rows.items() if runs and "kin" in runs[0]}
    return table_of(columns, asked, title="The same questions to all maps, held-out views, mIoU")


_COLLECTION = {
    "no semantics": ("rules", "none"),
    "flat": ("rules", "flat"),
    "flat, binary": ("flat", "binary"),
    "rules, one-hot": ("rules", "one-hot"),
    "rules, binary": ("rules", "binary"),
    "random, one-hot": ("random", "one-hot"),
    "random, binary": ("random", "binary"),
    "colour": ("rules", "colour"),
}
PAGES: dict[PageName, Page] = {
    "widths": Page(
        "taxonomies",
        "Widths of class trees",
        "Trees that the offline rules build for the classes of three datasets, 200 and 550 object "
        "names (`benchmarks/data`; the latter are like those of ScanNet), and 1000 names: these "
        "550 and 450 further words of the built-in vocabulary. One-hot channels are the sum of the "
        "level widths (H-7), binary channels the sum of their logarithms to base 2, rounded up "
        "(H-8).",
        {name: {"list": name} for name in class_lists()},
        measure_widths,
        lambda rows: [table_of(_WIDTHS, rows, "list")],
        measures=("toolkit/semantics",),
    ),
    "many-classes": Page(
        "many-classes",
        "A room with 300 classes, by code and tree",
        "`semsplat run --poses given --evaluation.subset` on a synthetic room whose walls are "
        "covered with shelves of small objects (`semsplat make-room --classes 300 --frames 100 "
        "--image-size 160 120`): 300 classes, of which the labels show nearly all. Trees: by the "
        "built-in rules, and the same with randomly assigned classes. Flat has one channel per "
        "class; flat, binary is the number of the class in bits, a tree of one level; colour has "
        "three channels for all. Level 0 is the coarsest level of the row's tree. Subset mIoU "
        f"decodes each view among the classes of its own ground truth, as H-VII does. {_QUESTIONS}",
        _jobs("collection", "--poses given --evaluation.subset", _COLLECTION),
        measure_map,
        lambda rows: [table_of(_MANY, rows), _questions(rows)],
        many_targets,
    ),
    "room": Page(
        "trees-room",
        "Semantic trees: room",
        "The table H-IX for the synthetic room, tracked and mapped (`semsplat make-room`, 300 "
        "frames, `--image-size 160 120`). Trees of Replica's classes: the shipped one; by the "
        "words for size and function; by the shapes measured in the labelled frames; by both "
        "(`--shapes scans`); and random and alphabetical trees of the widths of the latter. "
        f"{_QUESTIONS}",
        _jobs("room", "--image-size 160 120", {name: (name, "one-hot") for name in _TREES_OF_ROOM}),
        measure_map,
        lambda rows: [table_of((*_QUALITY, "channels"), rows), _questions(rows)],
    ),
}


@dataclass(frozen=True, kw_only=True)
class TreeOptions(Options):
    """Measure class trees."""

    page: tyro.conf.Positional[PageName] = "widths"
    """Which page."""


def main() -> None:
    """Measure one page."""
    options = tyro.cli(TreeOptions)
    PAGES[options.page].write(options)


if __name__ == "__main__":
    main()
