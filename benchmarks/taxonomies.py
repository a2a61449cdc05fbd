"""Builds class trees with the offline rules and measures how wide their codes are.

    python -m benchmarks.taxonomies [--picture DIR]

Checks, each an error if it fails: every class appears exactly once; a second process with another
hash seed builds the same bytes; another order of the names builds the same tree.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import os
import random
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.baseline_trees import alphabetical_taxonomy, random_taxonomy
from benchmarks.report import publish
from benchmarks.results_file import RESULTS, Results, current_header
from benchmarks.scripted_model import scripted_tree
from benchmarks.tables import Table
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_building.builder import BuildOptions, build_taxonomy
from toolkit.semantics.taxonomy_building.rules import RuleGrouper
from toolkit.semantics.taxonomy_building.vocabulary import built_in
from toolkit.semantics.taxonomy_drawing import draw_taxonomy
from toolkit.semantics.taxonomy_parsing import folded
from toolkit.semantics.trees import shipped_taxonomy

DESCRIPTION = """\
Classes of three datasets, 200 and 550 object names (`benchmarks/data`; the latter are like those
of ScanNet), and 1000 names: these 550 and 450 further words of the built-in vocabulary. Beside the
tree that the rules build: the tree of a scripted language model of which a tenth of the answers and
items are wrong (`benchmarks/scripted_model.py`), a random and an alphabetical tree of the rules'
widths, which have no meaning, and no tree at all (flat). One-hot channels are the sum of the level
widths (H-7), binary channels the sum of their logarithms to base 2, rounded up (H-8). "Related" is
the share of pairs of sibling classes that have the same function in the vocabulary; since the rules
use the same vocabulary, it shows what chance gives, not how good the rules are. Checked: every
class appears exactly once in each tree; two processes build the same tree by the rules, whatever
the order of the names."""
DATA = Path(__file__).with_name("data")
DATASETS = ("replica", "nyu40", "scannet20")


def class_lists() -> dict[str, list[str]]:
    """Names by list, in the order of their ids or of the alphabet."""
    lists = {name: list(shipped_taxonomy(name).classes) for name in DATASETS}
    for path in sorted(DATA.glob("objects_*.txt")):
        lists[path.stem] = path.read_text(encoding="utf-8").splitlines()
    lists["objects_1000"] = thousand_names(lists["objects_550"])
    return lists


def thousand_names(names: Sequence[str]) -> list[str]:
    """The names and other words of the vocabulary, evenly spaced in it, 1000 in all."""
    known = {folded(name) for name in names}
    others = [entry.word for entry in built_in() if folded(entry.word) not in known]
    places = np.linspace(0, len(others) - 1, 1000 - len(names)).astype(int)
    return [*names, *(others[place] for place in places)]


def build(name: str, classes: Sequence[str]) -> Taxonomy:
    """Our tree of a list."""
    return build_taxonomy(classes, RuleGrouper(), options=BuildOptions(name=name))


def channels(taxonomy: Taxonomy) -> tuple[int, int]:
    """One-hot and binary channels."""
    widths = taxonomy.level_widths
    return sum(widths), sum(math.ceil(math.log2(width)) for width in widths)


def related(taxonomy: Taxonomy) -> float:
    """Share of pairs of sibling classes that have the same function in the vocabulary."""
    families: dict[tuple[str, ...], list[str]] = {}
    for node in taxonomy.nodes:
        if node.leaf:
            families.setdefault(node.path[:-1], []).append(node.name)
    look_up = built_in().look_up
    pairs = [pair for names in families.values() for pair in itertools.combinations(names, 2)]
    same = [look_up(a).function == look_up(b).function for a, b in pairs]
    return sum(same) / max(len(same), 1)


def check_classes(classes: Sequence[str], taxonomy: Taxonomy) -> None:
    """Check that every class appears exactly once.

    Raises:
        SystemExit: it does not.
    """
    if sorted(node.name for node in taxonomy.nodes if node.leaf) != sorted(classes):
        raise SystemExit(f"{taxonomy.name}: not every class appears exactly once")


def check_order(name: str, classes: Sequence[str], taxonomy: Taxonomy) -> None:
    """Check that the order of the names does not change the tree.

    Raises:
        SystemExit: it does.
    """
    shuffled = random.Random(1).sample(list(classes), len(classes))
    paths = [node.path for node in build(name, shuffled).nodes]
    if paths != [node.path for node in taxonomy.nodes]:
        raise SystemExit(f"{name}: the order of the names changes the tree")


def digests() -> dict[str, str]:
    """Of the tree of every list."""
    return {name: build(name, classes).digest for name, classes in class_lists().items()}


def digests_of_another_process() -> dict[str, str]:
    """The same, with another order of sets and dictionaries' hashes."""
    command = [sys.executable, "-m", "benchmarks.taxonomies", "--digests"]
    environment = os.environ | {"PYTHONHASHSEED": "12345"}
    printed = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    return json.loads(printed.stdout)


def main() -> None:
    """Measure one row for each tree."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--picture", type=Path, help="folder for a drawing of each tree")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results file")
    parser.add_argument("--digests", action="store_true", help="print hashes alone, as JSON")
    arguments = parser.parse_args()
    if arguments.digests:
        print(json.dumps(digests()))
        return
    header = current_header((), ("toolkit/semantics", "toolkit/semantics/taxonomy_building"))
    others = digests_of_another_process()
    rows: list[tuple[str, ...]] = []
    for name, classes in class_lists().items():
        start = time.perf_counter()
        ours = build(name, classes)
        seconds = {"rules": time.perf_counter() - start}
        check_order(name, classes, ours)
        if others[name] != ours.digest:
            raise SystemExit(f"{name}: two processes build different trees")
        start = time.perf_counter()
        scripted = scripted_tree(classes)
        seconds["scripted model"] = time.perf_counter() - start
        trees = {
            "rules": ours,
            "scripted model": scripted,
            "random": random_taxonomy(ours, seed=0),
            "alphabetical": alphabetical_taxonomy(ours),
            "none (flat)": Taxonomy.flat(classes),
        }
        for kind, taxonomy in trees.items():
            check_classes(classes, taxonomy)
            widths = " + ".join(map(str, taxonomy.level_widths))
            cells = (name, len(classes), kind, widths, *channels(taxonomy))
            built_s = f"{seconds[kind]:.2f}" if kind in seconds else ""
            rows.append((*map(str, cells), f"{related(taxonomy):.0%}", built_s))
        if arguments.picture:
            draw_taxonomy(ours, arguments.picture / f"{name}.png")
    columns = ("list", "classes", "tree", "widths", "one-hot", "binary", "related", "build s")
    table = Table(columns, tuple(rows))
    title = "Widths of class trees"
    publish(Results("taxonomies", title, DESCRIPTION, header, (table,)), arguments.out)


if __name__ == "__main__":
    main()
