"""The semantic tree: a class is the path from the root to its leaf (H-III.A)."""

from __future__ import annotations

import difflib
import functools
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import FormatError
from toolkit.io.atomic import replacing
from toolkit.semantics.taxonomy_parsing import VOID_NAME as VOID_NAME
from toolkit.semantics.taxonomy_parsing import (
    Tree,
    check_classes,
    check_leaves,
    check_levels,
    folded,
    is_names,
    leaf_paths,
    numbered_paths,
    shortened,
)

VOID = 0  # the class id of what has no label; classes count from 1


@dataclass(frozen=True)
class Node:
    """One node of the tree.

    Attributes:
        name: its own name.
        path: names from the root's child down to it.
        level: 0 for a child of the root.
        local_id: its number among its siblings, from 0.
        class_ids: the classes below it, ascending; a leaf has its own.
        leaf: whether it is a class.
    """

    name: str
    path: tuple[str, ...]
    level: int
    local_id: int
    class_ids: tuple[int, ...]
    leaf: bool

    def __str__(self) -> str:
        return " > ".join(self.path)


class Taxonomy:
    """A tree over the classes 1..C. It never changes once made.

    Children are numbered locally, within their parent, in the order they are given. A class
    that ends early is padded: below its last level it is an only child, number 0.

    Args:
        tree: nested mappings from name to subtree; a list of names ends a branch.
        levels: a name for each level, top first, no two alike; as many as the deepest
            class has.
        classes: class names in the order of their ids 1..C; the tree's own order if None.
        name: what the tree is called.

    Attributes:
        classes: names by class id - 1.
        levels: names of the levels.
        local_ids: [C, L] int32, a class's number among its siblings at each level.
        node_ids: [C, L] int32, indices into `nodes` of its ancestors, itself at the end.

    Raises:
        FormatError: no or one class, names that are not text, repeated class names, repeated
            siblings, empty groups, or levels and classes that do not match the tree. Names
            that differ in case, hyphens or spaces alone are the same name.
    """

    def __init__(
        self,
        tree: Tree,
        levels: Sequence[str] | None = None,
        classes: Sequence[str] | None = None,
        name: str = "taxonomy",
    ) -> None:
        self.name = name
        leaves = leaf_paths(tree)
        check_leaves(leaves)
        by_name = {path[-1]: path for path in leaves}
        self.classes: tuple[str, ...] = tuple(by_name if classes is None else classes)
        check_classes(self.classes, leaves)
        depth = max(len(path) for path in leaves)
        default = [f"level {i}" for i in range(depth)]
        self.levels: tuple[str, ...] = tuple(default if levels is None else levels)
        check_levels(self.levels, depth)
        self._leaf_paths = tuple(by_name[c] for c in self.classes)
        self._local_ids = dict(numbered_paths(tree))
        self._nodes = self._make_nodes()
        self.local_ids, self.node_ids = self._make_tables()

    def __len__(self) -> int:
        """Number of classes, without void."""
        return len(self.classes)

    def __str__(self) -> str:
        widths = ", ".join(f"{n}: {w}" for n, w in zip(self.levels, self.level_widths, strict=True))
        return f"{self.name}: {len(self)} classes, {self.depth} levels ({widths})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Taxonomy) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    @property
    def depth(self) -> int:
        """Number of levels, the classes' own included."""
        return len(self.levels)

    @property
    def nodes(self) -> tuple[Node, ...]:
        """All nodes, parents before children, siblings by number; `node_ids` index them."""
        return self._nodes

    @functools.cached_property
    def level_widths(self) -> tuple[int, ...]:
        """The largest number of siblings at each level, H's n_l."""
        return tuple(int(self.local_ids[:, level].max()) + 1 for level in range(self.depth))

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of structure, class ids and level names; the tree's own name is no part."""
        text = json.dumps(
            {"paths": self._leaf_paths, "local": self.local_ids.tolist(), "levels": self.levels},
            ensure_ascii=False,
        )
        return hashlib.sha256(text.encode()).hexdigest()

    def path(self, class_id: int) -> tuple[str, ...]:
        """Names from the root's child to the class; void and unknown ids are a FormatError."""
        return self._leaf_paths[self._row(class_id)]

    def leaf(self, class_id: int) -> Node:
        """The node of a class."""
        return self.ancestor(class_id, self.depth - 1)

    def ancestor(self, class_id: int, level: int) -> Node:
        """The node above a class at a level; the class itself where it ends earlier."""
        return self._nodes[int(self.node_ids[self._row(class_id), level])]

    def common_ancestor(self, first: int, second: int) -> Node | None:
        """The lowest node above two classes, or None where only the root is."""
        ours, theirs = self.node_ids[self._row(first)], self.node_ids[self._row(second)]
        shared = np.flatnonzero(ours == theirs)
        return self._nodes[int(ours[shared[-1]])] if len(shared) else None

    def find_all(self, query: str) -> tuple[Node, ...]:
        """All nodes of a name, or of a path "a > b > c" that may start anywhere.

        The same group may stand in several branches, as seats do under every size. Upper
        case, hyphens and surrounding space do not matter. Empty where there is none.
        """
        wanted = tuple(folded(part) for part in query.split(">"))
        length = len(wanted)
        return tuple(n for n in self._nodes if tuple(folded(p) for p in n.path[-length:]) == wanted)

    def find(self, query: str) -> Node:
        """The one node that `find_all` finds; a class before groups of the same name.

        Raises:
            FormatError: there is none, or several; the message lists what was meant perhaps.
        """
        found = self.find_all(query)
        leaves = [n for n in found if n.leaf]
        if len(found) == 1 or len(leaves) == 1:
            return (leaves or found)[0]
        if found:
            several = "; ".join(str(n) for n in found[:5])
            raise FormatError(f"'{query}' names {len(found)} nodes: {several}; give a longer path")
        names = {folded(n.name): n.name for n in self._nodes}
        close = difflib.get_close_matches(folded(query.rpartition(">")[2]), names, n=3)
        hint = f"; did you mean {' or '.join(names[c] for c in close)}?" if close else ""
        raise FormatError(f"no class or group '{query}' in taxonomy '{self.name}'{hint}")

    def level_ids(self, class_ids: NDArray[np.integer], level: int) -> NDArray[np.int32]:
        """Node indices of class ids at a level, -1 for void; any shape.

        Raises:
            FormatError: an id that is neither void nor a class.
        """
        wrong = class_ids[(class_ids < VOID) | (class_ids > len(self))]
        if wrong.size:
            raise FormatError(self._no_such_class(int(wrong[0])))
        table = np.concatenate([[-1], self.node_ids[:, level]]).astype(np.int32)
        return table[class_ids]

    def nodes_at(self, level: int) -> tuple[Node, ...]:
        """The distinct nodes that classes have at a level, padded ones included."""
        return tuple(self._nodes[i] for i in np.unique(self.node_ids[:, level]))

    def relabelling(self, names: Mapping[int, str], source: str = "labels") -> NDArray[np.int32]:
        """Table from a data set's class ids to this tree's, by name; gaps are -1.

        Case, hyphens and spaces do not matter; plurals do.

        Args:
            names: the data set's class names by id, from 1, without its void.
            source: what to call them in an error, a file perhaps.

        Raises:
            FormatError: a class that this tree does not have, or an id below 1.
        """
        if min(names, default=1) <= VOID:
            raise FormatError(f"{source}: class ids count from 1, got {min(names)}")
        ids = {folded(n): i for i, n in enumerate(self.classes, start=1)}
        unknown = [n for n in names.values() if folded(n) not in ids]
        if unknown:
            raise FormatError(
                f"{source}: taxonomy '{self.name}' has no class {', '.join(unknown[:5])}"
                + (f" and {len(unknown) - 5} more" if len(unknown) > 5 else "")
                + "; give a taxonomy made for these classes (semsplat build-taxonomy)"
            )
        table = np.full(max(names, default=0) + 1, -1, np.int32)
        table[VOID] = VOID
        for number, label in names.items():
            table[number] = ids[folded(label)]
        return table

    def tree(self) -> dict[str, Any]:
        """The nested form that the constructor takes; a leaf's value is an empty mapping."""
        root: dict[str, Any] = {}
        for node in self._nodes:
            branch = root
            for part in node.path[:-1]:
                branch = branch[part]
            branch[node.name] = {}
        return root

    def to_json(self) -> dict[str, Any]:
        """JSON values from which `from_json` makes the same tree."""
        return {
            "name": self.name,
            "levels": list(self.levels),
            "classes": list(self.classes),
            "tree": shortened(self.tree()),
        }

    def save(self, path: str | Path) -> None:
        """Write YAML, or JSON where the name ends so.

        Raises:
            RunFolderError: the file cannot be written.
        """
        values = self.to_json()
        if Path(path).suffix == ".json":
            text = json.dumps(values, indent=1, ensure_ascii=False) + "\n"
        else:
            from toolkit.semantics.taxonomy_files import yaml_of

            text = yaml_of(values)
        with replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8")

    @classmethod
    def from_json(cls, values: Mapping[str, Any], source: str = "taxonomy") -> Taxonomy:
        """A tree from JSON values.

        Raises:
            FormatError: a key is missing, unknown or of the wrong type, or the tree is wrong.
        """
        if not isinstance(values, Mapping) or not isinstance(values.get("tree"), Mapping | list):
            raise FormatError(f"{source}: a taxonomy needs 'tree', a mapping or a list")
        unknown = set(values) - {"name", "levels", "classes", "tree"}
        if unknown:
            raise FormatError(f"{source}: unknown key {', '.join(sorted(map(str, unknown)))}")
        for key in ("levels", "classes"):
            listed = values.get(key)
            if listed is not None and not is_names(listed):
                raise FormatError(f"{source}: '{key}' must be a list of names")
        try:
            return cls(
                values["tree"],
                values.get("levels"),
                values.get("classes"),
                str(values.get("name", "taxonomy")),
            )
        except FormatError as error:
            raise FormatError(f"{source}: {error}") from None

    @classmethod
    def flat(cls, classes: Sequence[str], name: str = "flat") -> Taxonomy:
        """A tree of one level: every class its own group."""
        check_classes(classes, [(c,) for c in classes])
        return cls(dict.fromkeys(classes), ["class"], classes, name)

    @classmethod
    def load(cls, path: str | Path) -> Taxonomy:
        """A tree from a YAML or JSON file.

        Raises:
            FormatError: the file is missing, is neither, or holds no valid tree.
        """
        from toolkit.semantics.taxonomy_files import read_values

        return cls.from_json(read_values(Path(path)), str(path))

    def _row(self, class_id: int) -> int:
        if not VOID < class_id <= len(self):
            raise FormatError(self._no_such_class(class_id))
        return class_id - 1

    def _no_such_class(self, class_id: int) -> str:
        return (
            f"class id {class_id} is not in taxonomy '{self.name}', whose ids are 1 to "
            f"{len(self)}; use the taxonomy that the labels were made with"
        )

    def _make_nodes(self) -> tuple[Node, ...]:
        below: dict[tuple[str, ...], list[int]] = {}
        for class_id, path in enumerate(self._leaf_paths, start=1):
            for level in range(len(path)):
                below.setdefault(path[: level + 1], []).append(class_id)
        leaves = set(self._leaf_paths)
        return tuple(
            Node(path[-1], path, len(path) - 1, local, tuple(below[path]), path in leaves)
            for path, local in self._local_ids.items()
        )

    def _make_tables(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Local ids and node indices [C, L] of every class's path, padded to full depth."""
        index = {node.path: i for i, node in enumerate(self._nodes)}
        local_ids = np.zeros((len(self), self.depth), np.int32)
        node_ids = np.zeros((len(self), self.depth), np.int32)
        for row, path in enumerate(self._leaf_paths):
            for level in range(self.depth):
                node = index[path[: level + 1]]  # of the whole path once that has ended
                node_ids[row, level] = node
                local_ids[row, level] = self._nodes[node].local_id if level < len(path) else 0
        local_ids.setflags(write=False)
        node_ids.setflags(write=False)
        return local_ids, node_ids
