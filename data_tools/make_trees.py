"""Build the class trees that are shipped: `python data_tools/make_trees.py [--out DIR]`.

The offline rules alone decide; running it again gives the same files, byte for byte.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from toolkit.datasets.synthetic.vocabulary import CLASS_NAMES
from toolkit.semantics import trees as shipped
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.taxonomy_building.builder import BuildOptions, build_taxonomy
from toolkit.taxonomy_building.rules import RuleGrouper

TREES = Path(shipped.__file__).parent

# Names as the data sets write them, in the order of their ids.
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
    """Every tree that is shipped."""

    def built(name: str, classes: Sequence[str], options: BuildOptions | None = None) -> Taxonomy:
        return build_taxonomy(classes, RuleGrouper(), options=options or BuildOptions(name=name))

    function_alone = BuildOptions(aspects=("function",), most_functions=2, name="geometric")
    return [
        built("replica", CLASS_NAMES),
        built("nyu40", _names(NYU40)),
        built("scannet20", _names(SCANNET20)),
        built("geometric", _names(GEOMETRIC), function_alone),
    ]


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.replace("\n", " ").split(",")]


def main(arguments: Sequence[str] | None = None) -> None:
    """Write one YAML file a tree."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=TREES)
    out = parser.parse_args(arguments).out
    for taxonomy in trees():
        path = out / f"{taxonomy.name}.yaml"
        taxonomy.save(path)
        print(f"{path}: {taxonomy}")


if __name__ == "__main__":
    main()
