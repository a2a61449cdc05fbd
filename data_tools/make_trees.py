"""Build the taxonomies of the package: `python data_tools/make_trees.py [--out DIR]`.

Only the offline rules are used; the output is byte-for-byte reproducible.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_NAMES
from toolkit.semantics import trees as bundled
from toolkit.semantics.segmenters.indoor.classes import (
    INDOOR_CLASSES,
    INDOOR_TREE,
    OTHER_FURNITURE,
)
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_building.builder import BuildOptions, build_taxonomy
from toolkit.semantics.taxonomy_building.rules import RuleGrouper

TREES = Path(bundled.__file__).parent

# Class names of the datasets in the order of their ids.
NYU40 = """
wall, floor, cabinet, bed, chair, sofa, table, door, window, bookshelf, picture, counter, blinds,
desk, shelves, curtain, dresser, pillow, mirror, floor mat, clothes, ceiling, books, refridgerator,
television, paper, towel, shower curtain, box, whiteboard, person, night stand, toilet, sink, lamp,
bathtub, bag, otherstructure, otherfurniture, otherprop
"""
SCANNET20 = """
wall, floor, cabinet, bed, chair, sofa, table, door, window, bookshelf, picture, counter, desk,
curtain, refrigerator, shower curtain, toilet, sink, bathtub, otherfurniture
"""
GEOMETRIC = "floor, wall, ceiling, surface, object"


def trees() -> list[Taxonomy]:
    """Build all taxonomies of the package."""

    def build(name: str, classes: Sequence[str], options: BuildOptions | None = None) -> Taxonomy:
        return build_taxonomy(classes, RuleGrouper(), options=options or BuildOptions(name=name))

    function_only = BuildOptions(aspects=("function",), max_functions=2, name="geometric")
    return [
        build("replica", CLASS_NAMES),
        build("nyu40", _names(NYU40)),
        build("scannet20", _names(SCANNET20)),
        build("geometric", _names(GEOMETRIC), function_only),
        _indoor(),
    ]


def _indoor() -> Taxonomy:
    tree: dict[str, dict[str, dict[str, dict[str, str]]]] = {
        kind: {group: {name: {} for name in names} for group, names in groups.items()}
        for kind, groups in INDOOR_TREE.items()
    }
    classes = (*INDOOR_CLASSES, OTHER_FURNITURE)
    return Taxonomy(tree, ("kind", "group", "class"), classes, "indoor")


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.replace("\n", " ").split(",")]


def main(arguments: Sequence[str] | None = None) -> None:
    """Write one YAML file per taxonomy."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=TREES)
    out = parser.parse_args(arguments).out
    for taxonomy in trees():
        path = out / f"{taxonomy.name}.yaml"
        taxonomy.save(path)
        print(f"{path}: {taxonomy}")


if __name__ == "__main__":
    main()
