"""Format a taxonomy as an indented text tree."""

from __future__ import annotations

from toolkit.semantics.taxonomy import Taxonomy


def tree_text(taxonomy: Taxonomy) -> str:
    """Format the tree with one node per line; groups show their level and number of classes."""
    lines = [str(taxonomy)]
    for node in taxonomy.nodes:
        level, count = taxonomy.levels[node.level], len(node.class_ids)
        note = "" if node.leaf else f"  ({level}, {count} classes)"
        lines.append(f"{'  ' * (node.level + 1)}{node.name}{note}")
    return "\n".join(lines) + "\n"
