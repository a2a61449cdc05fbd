"""The semantic tree; a class is represented by the path from the root to its leaf (H-III.A)."""

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

from toolkit.base.errors import FormatError
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

VOID = 0  # class id of unlabelled pixels; the ids of classes start at 1


@dataclass(frozen=True)
class Node:
    """One node of the tree.

    Attributes:
        name: name of the node.
        path: names from the child of the root to the node.
        level: level of the node; 0 for a child of the root.
        local_id: index of the node among its siblings, from 0.
        class_ids: ids of the classes below the node, ascending; of a leaf, its own id.
        leaf: whether the node is a class.
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
    """An immutable tree over the classes 1..C.

    Children are numbered within their parent in the given order. Classes above the last level are
    padded: at the levels below, the class is its own only child with local id 0.

    Args:
        tree: nested mappings from name to subtree; a list of names marks leaves.
        levels: a distinct name for each level, top first; as many as the depth of the tree.
        classes: class names in the order of their ids 1..C; None for the order of the tree.
        name: name of the tree.

    Attributes:
        classes: names by class id - 1.
        levels: names of the levels.
        local_ids: [C, L] int32, index among its siblings of each class's node at each level.
        node_ids: [C, L] int32, index into `nodes` of each class's node at each level; the last
            one is the class itself.

    Raises:
        FormatError: fewer than two classes, names that are not text, repeated class names,
            repeated siblings, empty groups, or levels or classes that do not match the tree.
            Names are compared without case, hyphens and spaces.
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
        """Number of levels, including that of the classes."""
        return len(self.levels)

    @property
    def nodes(self) -> tuple[Node, ...]:
        """All nodes, parents before children, siblings by local id; indexed by `node_ids`."""
        return self._nodes

    @functools.cached_property
    def level_widths(self) -> tuple[int, ...]:
        """The maximum number of siblings at each level (n_l in Hier-SLAM)."""
        return tuple(int(self.local_ids[:, level].max()) + 1 for level in range(self.depth))

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of structure, class ids and level names, without the name of the tree."""
        text = json.dumps(
            {"paths": self._leaf_paths, "local": self.local_ids.tolist(), "levels": self.levels},
            ensure_ascii=False,
        )
        return hashlib.sha256(text.encode()).hexdigest()

    def path(self, class_id: int) -> tuple[str, ...]:
        """Return the names from the child of the root to the class.

        Raises:
            FormatError: the id is void or unknown.
        """
        return self._leaf_paths[self._row(class_id)]

    def leaf(self, class_id: int) -> Node:
        """Return the node of a class."""
        return self.ancestor(class_id, self.depth - 1)

    def ancestor(self, class_id: int, level: int) -> Node:
        """Return the ancestor of a class at a level, or the class itself if it is above it."""
        return self._nodes[int(self.node_ids[self._row(class_id), level])]

    def common_ancestor(self, first: int, second: int) -> Node | None:
        """Return the lowest common ancestor of two classes, or None if it is the root."""
        ours, theirs = self.node_ids[self._row(first)], self.node_ids[self._row(second)]
        shared = np.flatnonzero(ours == theirs)
        return self._nodes[int(ours[shared[-1]])] if len(shared) else None

    def find_all(self, query: str) -> tuple[Node, ...]:
        """Return all nodes with a name, or whose path ends with "a > b > c".

        Several groups can have the same name in different branches. Names are compared without
        case, hyphens and surrounding space.
        """
        suffix = tuple(folded(part) for part in query.split(">"))
        length = len(suffix)
        return tuple(n for n in self._nodes if tuple(folded(p) for p in n.path[-length:]) == suffix)

    def find(self, query: str) -> Node:
        """Return the only match of `find_all`; a class has priority over groups of the same name.

        Raises:
            FormatError: there is no match, or several; the message lists candidates.
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
        """Return the node indices of class ids of any shape at a level, -1 for void.

        Raises:
            FormatError: an id is neither void nor a class.
        """
        wrong = class_ids[(class_ids < VOID) | (class_ids > len(self))]
        if wrong.size:
            raise FormatError(self._no_such_class(int(wrong[0])))
        table = np.concatenate([[-1], self.node_ids[:, level]]).astype(np.int32)
        return table[class_ids]

    def nodes_at(self, level: int) -> tuple[Node, ...]:
        """Return the distinct nodes of the classes at a level, including padded ones."""
        return tuple(self._nodes[i] for i in np.unique(self.node_ids[:, level]))

    def relabelling(self, names: Mapping[int, str], source: str = "labels") -> NDArray[np.int32]:
        """Return a table from a dataset's class ids to those of this tree, -1 for unused ids.

        Classes are assigned by name, without case, hyphens and spaces. Plurals are different names.

        Args:
            names: the dataset's class names by id, from 1, without void.
            source: name of the vocabulary in errors, for instance a file.

        Raises:
            FormatError: this tree lacks a class, or an id is below 1.
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
        """Return the nested form for the constructor; the value of a leaf is an empty mapping."""
        root: dict[str, Any] = {}
        for node in self._nodes:
            branch = root
            for part in node.path[:-1]:
                branch = branch[part]
            branch[node.name] = {}
        return root

    def to_json(self) -> dict[str, Any]:
        """Return JSON values from which `from_json` restores the tree."""
        return {
            "name": self.name,
            "levels": list(self.levels),
            "classes": list(self.classes),
            "tree": shortened(self.tree()),
        }

    def save(self, path: str | Path) -> None:
        """Write a YAML file, or a JSON file if the suffix is ".json".

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
        """Build a tree from JSON values.

        Raises:
            FormatError: a key is missing, unknown or of the wrong type, or the tree is invalid.
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
        """Build a tree of one level."""
        check_classes(classes, [(c,) for c in classes])
        return cls(dict.fromkeys(classes), ["class"], classes, name)

    @classmethod
    def load(cls, path: str | Path) -> Taxonomy:
        """Read a tree from a YAML or JSON file.

        Raises:
            FormatError: the file is missing, or does not contain a valid tree.
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
        """Return local ids and node indices [C, L] of every class's path, padded to full depth."""
        index = {node.path: i for i, node in enumerate(self._nodes)}
        local_ids = np.zeros((len(self), self.depth), np.int32)
        node_ids = np.zeros((len(self), self.depth), np.int32)
        for row, path in enumerate(self._leaf_paths):
            for level in range(self.depth):
                node = index[path[: level + 1]]  # the class itself below its last level
                node_ids[row, level] = node
                local_ids[row, level] = self._nodes[node].local_id if level < len(path) else 0
        local_ids.setflags(write=False)
        node_ids.setflags(write=False)
        return local_ids, node_ids
