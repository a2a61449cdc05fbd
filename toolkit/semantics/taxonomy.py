"""The semantic tree: a class is the path from the root to its leaf (H-III.A)."""

from __future__ import annotations

import difflib
import functools
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from toolkit.errors import FormatError
from toolkit.io.atomic import replacing

VOID = 0  # the class id of what has no label; classes count from 1
VOID_NAME = "void"

# From name to subtree; a list of names, or an empty mapping, ends a branch.
Tree = Mapping[str, Any]


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
        levels: a name for each level, top first; as many as the deepest class has.
        classes: class names in the order of their ids 1..C; the tree's own order if None.
        name: what the tree is called.

    Attributes:
        classes: names by class id - 1.
        levels: names of the levels.
        local_ids: [C, L] int32, a class's number among its siblings at each level.
        node_ids: [C, L] int32, indices into `nodes` of its ancestors, itself at the end.

    Raises:
        FormatError: no or one class, names that are not text, repeated class names, repeated
            siblings, empty groups, or levels and classes that do not match the tree.
    """

    def __init__(
        self,
        tree: Tree,
        levels: Sequence[str] | None = None,
        classes: Sequence[str] | None = None,
        name: str = "taxonomy",
    ) -> None:
        self.name = name
        leaves = list(_leaf_paths(tree, ()))
        names = [path[-1] for path in leaves]
        _check_names(names, leaves)
        self.classes: tuple[str, ...] = tuple(names if classes is None else classes)
        _check_same(self.classes, names)
        depth = max(len(path) for path in leaves)
        default = [f"level {i}" for i in range(depth)]
        self.levels: tuple[str, ...] = tuple(default if levels is None else levels)
        if len(self.levels) != depth:
            raise FormatError(
                f"taxonomy '{name}' has {depth} levels but {len(self.levels)} level names"
            )
        by_name = {path[-1]: path for path in leaves}
        self._leaf_paths = tuple(by_name[c] for c in self.classes)
        self._local_ids = dict(_numbered(tree, ()))
        self._nodes = self._make_nodes()
        self.local_ids, self.node_ids = self._make_tables()

    def __len__(self) -> int:
        """Number of classes, without void."""
        return len(self.classes)

    def __str__(self) -> str:
        widths = ", ".join(f"{n} {w}" for n, w in zip(self.levels, self.level_widths, strict=True))
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
        """Names from the root's child to the class."""
        return self._leaf_paths[class_id - 1]

    def leaf(self, class_id: int) -> Node:
        """The node of a class."""
        return self._nodes[int(self.node_ids[class_id - 1, -1])]

    def ancestor(self, class_id: int, level: int) -> Node:
        """The node above a class at a level; the class itself where it ends earlier."""
        return self._nodes[int(self.node_ids[class_id - 1, level])]

    def common_ancestor(self, first: int, second: int) -> Node | None:
        """The lowest node above two classes, or None where only the root is."""
        shared = np.nonzero(self.node_ids[first - 1] == self.node_ids[second - 1])[0]
        return self._nodes[int(self.node_ids[first - 1, shared[-1]])] if len(shared) else None

    def find(self, query: str) -> Node:
        """A node by name, or by a path "a > b > c" that may start anywhere.

        Upper case and surrounding space do not matter.

        Raises:
            FormatError: there is none, or several; the message lists what was meant perhaps.
        """
        wanted = tuple(part.strip().casefold() for part in query.split(">"))
        found = [n for n in self._nodes if _folded(n.path)[-len(wanted) :] == wanted]
        if len(found) == 1:
            return found[0]
        if found:
            leaves = [n for n in found if n.leaf]
            if len(leaves) == 1:
                return leaves[0]
            several = "; ".join(str(n) for n in found[:5])
            raise FormatError(f"'{query}' names {len(found)} nodes: {several}; give a longer path")
        names = {n.name.casefold(): n.name for n in self._nodes}
        close = difflib.get_close_matches(wanted[-1], names, n=3)
        hint = f"; did you mean {' or '.join(names[c] for c in close)}?" if close else ""
        raise FormatError(f"no class or group '{query}' in taxonomy '{self.name}'{hint}")

    def level_ids(self, class_ids: NDArray[np.integer], level: int) -> NDArray[np.int32]:
        """Node indices of class ids at a level, -1 for void; any shape."""
        table = np.concatenate([[-1], self.node_ids[:, level]]).astype(np.int32)
        return table[class_ids]

    def nodes_at(self, level: int) -> tuple[Node, ...]:
        """The distinct nodes that classes have at a level, padded ones included."""
        return tuple(self._nodes[i] for i in np.unique(self.node_ids[:, level]))

    def relabelling(self, names: Mapping[int, str], source: str = "labels") -> NDArray[np.int32]:
        """Table from a data set's class ids to this tree's, by name; gaps are -1.

        Args:
            names: the data set's class names by id, without its void.
            source: what to call them in an error, a file perhaps.

        Raises:
            FormatError: a class that this tree does not have.
        """
        ids = {n.casefold(): i for i, n in enumerate(self.classes, start=1)}
        unknown = [n for n in names.values() if n.casefold() not in ids]
        if unknown:
            raise FormatError(
                f"{source}: taxonomy '{self.name}' has no class {', '.join(unknown[:5])}"
                + (f" and {len(unknown) - 5} more" if len(unknown) > 5 else "")
                + "; give a taxonomy made for these classes (semsplat build-taxonomy)"
            )
        table = np.full(max(names, default=0) + 1, -1, np.int32)
        table[VOID] = VOID
        for number, label in names.items():
            table[number] = ids[label.casefold()]
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
            "tree": self.tree(),
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
            text = yaml.safe_dump(values, sort_keys=False, allow_unicode=True, width=100)
        with replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8")

    @classmethod
    def from_json(cls, values: Mapping[str, Any], source: str = "taxonomy") -> Taxonomy:
        """A tree from JSON values.

        Raises:
            FormatError: a key is missing, unknown or of the wrong type, or the tree is wrong.
        """
        if not isinstance(values, Mapping) or not isinstance(values.get("tree"), Mapping):
            raise FormatError(f"{source}: a taxonomy needs a mapping 'tree'")
        unknown = set(values) - {"name", "levels", "classes", "tree"}
        if unknown:
            raise FormatError(f"{source}: unknown key {', '.join(sorted(map(str, unknown)))}")
        for key in ("levels", "classes"):
            listed = values.get(key)
            if listed is not None and not _is_names(listed):
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
        return cls({c: {} for c in _unique(classes)}, ["class"], classes, name)

    @classmethod
    def load(cls, path: str | Path) -> Taxonomy:
        """A tree from a YAML or JSON file.

        Raises:
            FormatError: the file is missing, is neither, or holds no valid tree.
        """
        path = Path(path)
        try:
            # JSON is YAML; the loader that keeps duplicate keys apart finds both.
            values = yaml.load(path.read_text(encoding="utf-8"), Loader=_UniqueKeys)
        except (OSError, UnicodeDecodeError) as error:
            raise FormatError(f"{path}: cannot be read ({error})") from error
        except yaml.YAMLError as error:
            reason = str(error).replace("\n", " ")
            raise FormatError(f"{path}: is neither YAML nor JSON ({reason})") from error
        return cls.from_json(values, str(path))

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


def _leaf_paths(tree: Any, above: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    for name, children in _children(tree, above):
        path = (*above, name)
        if children:
            yield from _leaf_paths(children, path)
        else:
            yield path


def _numbered(tree: Any, above: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], int]]:
    """All nodes, parents first, each with its number among its siblings."""
    for number, (name, children) in enumerate(_children(tree, above)):
        yield (*above, name), number
        if children:
            yield from _numbered(children, (*above, name))


def _children(tree: Any, above: tuple[str, ...]) -> list[tuple[str, Any]]:
    where = " > ".join(above) or "the root"
    if isinstance(tree, Mapping):
        pairs = list(tree.items())
    elif isinstance(tree, Sequence) and not isinstance(tree, str):
        pairs = [(name, None) for name in tree]
    else:
        raise FormatError(f"{where} must hold a mapping or a list of names, not {tree!r}")
    for name, children in pairs:
        if not isinstance(name, str) or not name.strip():
            raise FormatError(f"{where} holds {name!r}, which is no name; put it in quotes")
        if ">" in name:
            raise FormatError(f"{where} holds {name!r}: '>' separates the parts of a path")
        if isinstance(children, list) and not children:
            raise FormatError(f"{where} holds an empty group '{name}'")
    names = [name.casefold() for name, _ in pairs]
    repeated = {n for n in names if names.count(n) > 1}
    if repeated:
        raise FormatError(f"{where} holds {', '.join(sorted(repeated))} twice")
    return pairs


def _check_names(names: list[str], leaves: list[tuple[str, ...]]) -> None:
    if len(names) < 2:
        raise FormatError(f"a taxonomy needs two classes or more, this one has {len(names)}")
    seen: dict[str, tuple[str, ...]] = {}
    for name, path in zip(names, leaves, strict=True):
        folded = name.casefold()
        if folded == VOID_NAME:
            raise FormatError(f"'{name}' is no class: it is the absence of one")
        if folded in seen:
            raise FormatError(
                f"class '{name}' appears twice: {' > '.join(seen[folded])} and {' > '.join(path)}"
            )
        seen[folded] = path


def _check_same(classes: Sequence[str], leaves: Sequence[str]) -> None:
    _unique(classes)
    missing = sorted(set(classes) - set(leaves))
    extra = sorted(set(leaves) - set(classes))
    if missing:
        raise FormatError(f"the tree lacks the class(es) {', '.join(missing[:5])}")
    if extra:
        raise FormatError(f"the tree holds {', '.join(extra[:5])}, not in its list of classes")


def _unique(classes: Sequence[str]) -> Sequence[str]:
    repeated = sorted({c for c in classes if list(classes).count(c) > 1})
    if repeated:
        raise FormatError(f"class name(s) given twice: {', '.join(repeated[:5])}")
    return classes


def _is_names(values: object) -> bool:
    return isinstance(values, list) and all(isinstance(v, str) for v in values)


def _folded(path: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(part.casefold() for part in path)


class _UniqueKeys(yaml.SafeLoader):
    """YAML whose mappings may not repeat a key: silently, the last one would win."""


def _construct_mapping(loader: _UniqueKeys, node: yaml.MappingNode) -> dict:
    pairs = [(loader.construct_object(k, True), v) for k, v in node.value]
    keys = [str(k) for k, _ in pairs]
    for key in keys:
        if keys.count(key) > 1:
            raise yaml.constructor.ConstructorError(None, None, f"'{key}' is given twice")
    return {k: loader.construct_object(v, True) for k, v in pairs}


_UniqueKeys.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _construct_mapping)
