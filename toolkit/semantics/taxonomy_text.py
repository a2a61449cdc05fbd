"""Format a taxonomy as an indented text tree."""

from __future__ import annotations

from toolkit.semantics.taxonomy import Node, Taxonomy


def tree_text(taxonomy: Taxonomy, local_ids: bool = False) -> str:
    """Format the tree with one node per line; groups show their level and number of classes.

    Args:
        local_ids: also show the index of every node among its siblings, and the numeric path and
            class id of every class.
    """
    lines = [str(taxonomy)]
    for node in taxonomy.nodes:
        number = f"{node.local_id} " if local_ids else ""
        lines.append(
            f"{'  ' * (node.level + 1)}{number}{node.name}{_note(taxonomy, node, local_ids)}"
        )
    return "\n".join(lines) + "\n"


def _note(taxonomy: Taxonomy, node: Node, local_ids: bool) -> str:
    """Return the note that follows a name."""
    if not node.leaf:
        return f"  ({taxonomy.levels[node.level]}, {len(node.class_ids)} classes)"
    if not local_ids:
        return ""
    (class_id,) = node.class_ids
    numbers = taxonomy.local_ids[class_id - 1, : node.level + 1]
    return f"  ({'.'.join(map(str, numbers))}, class {class_id})"
