"""Do trees scale to hundreds of classes? A room with 300 classes, mapped with each code and tree.

python -m benchmarks.many_classes
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from benchmarks.baseline_trees import random_taxonomy
from benchmarks.recordings import room, sequence_arguments
from benchmarks.report import Report, ReportOptions
from benchmarks.runs import finished_run
from benchmarks.scripted_model import scripted_tree
from benchmarks.tables import Metrics, Rows, Table, Target, median_of, table_of, target_table
from benchmarks.taxonomies import channels
from benchmarks.trees import tree_metrics
from toolkit.runs.maps.finished import load_run
from toolkit.semantics.taxonomy import Taxonomy

ROOM = "collection"
DESCRIPTION = """\
`semsplat run --poses given --hold-out 5 --evaluation.subset` on a synthetic room whose walls are
covered with shelves of small objects (`semsplat make-room --classes 300 --frames 100 --image-size
160 120`): 300 classes, of which the labels show nearly all. Trees: by the built-in rules; by a
scripted language model of which a tenth of the answers and items are wrong
(`benchmarks/scripted_model.py`); and the rules' tree with randomly assigned classes. Flat has one
channel per class; flat, binary is the number of the class in bits, a tree of one level; colour has
three channels for all. Own level 0 is the coarsest level of the row's tree.

Subset mIoU decodes each view among the classes of its own ground truth, as H-VII does. Below, all
rows are asked the same questions on the held-out views: the class of each pixel decides, and a
coarse query is a node of the rules' tree."""
COLUMNS = (
    "channels",
    "memory.map_mb",
    "memory.peak_mb",
    "semantics.mapped.miou_percent",
    "semantics.unseen.miou_percent",
    "semantics.mapped.miou_subset_percent",
    "semantics.unseen.miou_subset_percent",
    "semantics.mapped.level_0.miou_percent",
    "semantics.unseen.level_0.miou_percent",
    "images.mapped.psnr_db",
    "images.unseen.psnr_db",
    "time.mapping_ms_per_frame",
    "time.refinement_ms_per_frame",
    "map.gaussians",
)
# Name of a row: tree and code.
ROWS: dict[str, list[str]] = {
    "no semantics": ["rules", "none"],
    "flat": ["rules", "flat"],
    "flat, binary": ["flat", "binary"],
    "rules, one-hot": ["rules", "one-hot"],
    "rules, binary": ["rules", "binary"],
    "scripted model, one-hot": ["scripted", "one-hot"],
    "scripted model, binary": ["scripted", "binary"],
    "random, one-hot": ["random", "one-hot"],
    "random, binary": ["random", "binary"],
    "colour": ["rules", "colour"],
}


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Measure a room with hundreds of classes."""

    seeds: int = 1
    """Seeds 0, 1, ... of the run; a row is their median."""


def code_channels(tree: Taxonomy, code: str) -> int:
    """Number of semantic channels of a code."""
    one_hot, binary = channels(tree)
    known = {"none": 0, "flat": len(tree), "one-hot": one_hot, "binary": binary, "colour": 3}
    return known[code]


def trees() -> dict[str, Taxonomy]:
    """The trees by name."""
    rules = Taxonomy.load(room(ROOM) / "taxonomy.yaml")
    return {
        "rules": rules,
        "scripted": scripted_tree(rules.classes),
        "random": random_taxonomy(rules),
        "flat": Taxonomy.flat(rules.classes),
    }


def measure(tree: Taxonomy, ours: Taxonomy, code: str, seed: int) -> Metrics:
    """Metrics of a run, with the answers to the same questions on held-out views."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "tree.yaml"
        tree.save(file)
        words = ["--poses", "given", "--hold-out", "5", "--evaluation.subset"]
        words += ["--semantics.code.kind", code, "--semantics.taxonomy", str(file)]
        with finished_run([*sequence_arguments(ROOM), *words], seed) as (metrics, run):
            metrics["channels"] = code_channels(tree, code)
            metrics["widths"] = " + ".join(map(str, tree.level_widths))
            if code != "none":
                _, _, *levels, kin = tree_metrics(load_run(run.path), ours)
                metrics |= {f"query {level}": value for level, value in enumerate(levels)}
                metrics["kin"] = kin
            return metrics


def targets(rows: Rows) -> Table:
    """The claim: far fewer channels than flat, hardly less mIoU."""
    median = median_of(rows)

    def lost(row: str, column: str) -> float | None:
        flat, tree = median("flat", column), median(row, column)
        return None if flat is None or tree is None else flat - tree

    found = []
    for row, most in (("rules, one-hot", 1.0), ("rules, binary", 2.0)):
        for views in ("mapped", "unseen"):
            loss = lost(row, f"semantics.{views}.miou_percent")
            found.append(Target(f"{row} below flat, {views}, points of mIoU", loss, at_most=most))
        flat_mb, mb = median("flat", "memory.map_mb"), median(row, "memory.map_mb")
        share = None if flat_mb is None or mb is None else mb / flat_mb
        found.append(Target(f"{row}, size of the map of flat's", share, at_most=0.35))
    return target_table(found)


def main() -> None:
    """Measure one row for each tree and code."""
    options = tyro.cli(Options)
    title = "A room with 300 classes, by code and tree"
    report = Report("many-classes", title, DESCRIPTION, options, range(options.seeds))
    made = trees()

    def measured(job: Sequence[str], seed: int) -> Metrics:
        name, code = job
        return measure(made[name], made["rules"], code, seed)

    rows = report.measured(ROWS, measured)
    labelled = {name: runs for name, runs in rows.items() if name != "no semantics"}
    queries = (*(f"query {level}" for level in range(made["rules"].depth)), "kin", "widths")
    same = table_of(queries, labelled, title="The same questions to all maps, held-out views, mIoU")
    report.write(table_of(COLUMNS, rows), same, targets(rows))


if __name__ == "__main__":
    main()
