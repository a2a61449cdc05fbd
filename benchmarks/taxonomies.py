"""Builds class trees by the offline rules and prints how wide their codes are.

    python -m benchmarks.taxonomies [--picture DIR]

Lists: the classes of three data sets, and 200 and 550 object names in benchmarks/data. For each,
beside our tree: a random and an alphabetical tree of the same form (same widths, so the same
channels: what they lack is meaning), and no tree at all (flat, one channel a class).

Channels: one-hot is the sum of the level widths (H-7), binary the sum of their logarithms to
base 2, rounded up (H-8). "alike" is the share of pairs of classes under one lowest group that
the vocabulary gives the same function; a tree without meaning has few. It is counted by the
same vocabulary that built our tree, so it shows what chance gives, not how good ours is.

Checks, each an error where it fails: every class appears exactly once; a second process with
another hash seed builds the same bytes; another order of the names builds the same tree.
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
from collections.abc import Sequence
from pathlib import Path

from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_drawing import draw_taxonomy
from toolkit.semantics.trees import shipped_taxonomy
from toolkit.taxonomy_building.builder import BuildOptions, build_taxonomy
from toolkit.taxonomy_building.comparison import alphabetical_taxonomy, random_taxonomy
from toolkit.taxonomy_building.rules import RuleGrouper
from toolkit.taxonomy_building.vocabulary import built_in

DATA = Path(__file__).with_name("data")
DATASETS = ("replica", "nyu40", "scannet20")


def class_lists() -> dict[str, list[str]]:
    """Names by list, in the order of their ids or of the alphabet."""
    lists = {name: list(shipped_taxonomy(name).classes) for name in DATASETS}
    for path in sorted(DATA.glob("objects_*.txt")):
        lists[path.stem] = path.read_text(encoding="utf-8").splitlines()
    return lists


def build(name: str, classes: Sequence[str]) -> Taxonomy:
    """Our tree of a list."""
    return build_taxonomy(classes, RuleGrouper(), options=BuildOptions(name=name))


def channels(taxonomy: Taxonomy) -> tuple[int, int]:
    """One-hot and binary channels."""
    widths = taxonomy.level_widths
    return sum(widths), sum(math.ceil(math.log2(width)) for width in widths)


def alike(taxonomy: Taxonomy) -> float:
    """Share of sibling classes' pairs that have the same function in the vocabulary."""
    families: dict[tuple[str, ...], list[str]] = {}
    for node in taxonomy.nodes:
        if node.leaf:
            families.setdefault(node.path[:-1], []).append(node.name)
    look_up = built_in().look_up
    pairs = [pair for names in families.values() for pair in itertools.combinations(names, 2)]
    same = [look_up(a).function == look_up(b).function for a, b in pairs]
    return sum(same) / max(len(same), 1)


def check(name: str, classes: Sequence[str], taxonomy: Taxonomy) -> None:
    """The promises of the docstring.

    Raises:
        SystemExit: one is broken.
    """
    leaves = [node.name for node in taxonomy.nodes if node.leaf]
    if sorted(leaves) != sorted(classes) or len(set(leaves)) != len(leaves):
        raise SystemExit(f"{name}: not every class appears exactly once")
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
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--picture", type=Path, help="folder for a drawing of each tree")
    parser.add_argument("--digests", action="store_true", help="print hashes alone, as JSON")
    arguments = parser.parse_args()
    if arguments.digests:
        print(json.dumps(digests()))
        return
    print("| list | classes | tree | widths | one-hot | binary | alike |")
    print("| --- | ---: | --- | --- | ---: | ---: | ---: |")
    elsewhere = digests_of_another_process()
    for name, classes in class_lists().items():
        ours = build(name, classes)
        check(name, classes, ours)
        if elsewhere[name] != ours.digest:
            raise SystemExit(f"{name}: two processes build different trees")
        trees = {
            "rules": ours,
            "random": random_taxonomy(ours, seed=0),
            "alphabetical": alphabetical_taxonomy(ours),
            "none": Taxonomy.flat(classes),
        }
        for kind, taxonomy in trees.items():
            widths = " + ".join(map(str, taxonomy.level_widths))
            one_hot, binary = channels(taxonomy)
            row = (name, len(classes), kind, widths, one_hot, binary, f"{alike(taxonomy):.0%}")
            print("| " + " | ".join(map(str, row)) + " |", flush=True)
        if arguments.picture:
            draw_taxonomy(ours, arguments.picture / f"{name}.png")
    print("\nevery class once, two processes agree, the order of the names does not matter: yes")


if __name__ == "__main__":
    main()
