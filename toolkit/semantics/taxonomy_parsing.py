"""Validate and traverse the nested form of a taxonomy."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from toolkit.base.errors import FormatError
from toolkit.io.class_names import MAX_NAME, name_fault

VOID_NAME = "void"

# Mapping from name to subtree; a list of names or an empty mapping marks leaves.
Tree = Mapping[str, Any]


def folded(name: str) -> str:
    """Normalise a name for comparison: "TV-Stand " and "tv_stand" become "tv stand"."""
    return " ".join(name.casefold().replace("-", " ").replace("_", " ").split())


def leaf_paths(tree: Tree) -> list[tuple[str, ...]]:
    """Return the path of every leaf, in the order of the tree.

    Raises:
        FormatError: a name is not text, siblings have the same name, or a group is empty.
    """
    paths = [path for path, _ in numbered_paths(tree)]
    inner = {path[:-1] for path in paths}
    return [path for path in paths if path not in inner]


def numbered_paths(tree: Any, above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], int]]:
    """Yield the path of every node, parents first, with its index among its siblings."""
    for number, (name, children) in enumerate(_children(tree, above)):
        yield (*above, name), number
        if children:
            yield from numbered_paths(children, (*above, name))


def check_leaves(leaves: Sequence[tuple[str, ...]]) -> None:
    """Reject fewer than two classes, a class called void, and repeated classes."""
    if len(leaves) < 2:
        raise FormatError(f"a taxonomy needs two classes or more, this one has {len(leaves)}")
    seen: dict[str, tuple[str, ...]] = {}
    for path in leaves:
        name = folded(path[-1])
        if name == VOID_NAME:
            raise FormatError(f"'{path[-1]}' is reserved for unlabelled pixels; rename the class")
        if name in seen:
            raise FormatError(
                f"class '{path[-1]}' appears twice: {' > '.join(seen[name])} and {' > '.join(path)}"
            )
        seen[name] = path


def check_classes(classes: Sequence[str], leaves: Sequence[tuple[str, ...]]) -> None:
    """Reject a list of classes that differs from the leaves of the tree."""
    repeated = _repeated(classes)
    if repeated:
        raise FormatError(f"class name(s) given twice: {', '.join(repeated[:5])}")
    names = {path[-1] for path in leaves}
    missing = sorted(set(classes) - names)
    extra = sorted(names - set(classes))
    if missing:
        raise FormatError(f"the tree lacks the class(es) {', '.join(missing[:5])}")
    if extra:
        raise FormatError(
            f"the tree contains {', '.join(extra[:5])}, which is not in its list of classes"
        )


def check_levels(levels: Sequence[str], depth: int) -> None:
    """Reject level names that are repeated or do not match the number of levels."""
    if len(levels) != depth:
        raise FormatError(f"{depth} levels but {len(levels)} level names")
    repeated = _repeated(levels)
    if repeated:
        raise FormatError(f"level name(s) given twice: {', '.join(repeated)}")


def shortened(tree: Tree) -> dict[str, Any] | list[str]:
    """Return the same tree with groups that contain only classes written as lists."""
    if tree and not any(tree.values()):
        return list(tree)
    return {name: shortened(children) if children else {} for name, children in tree.items()}


def is_names(values: object) -> bool:
    """Return whether the value is a list of strings."""
    return isinstance(values, list) and all(isinstance(v, str) for v in values)


def _children(tree: Any, above: tuple[str, ...]) -> list[tuple[str, Any]]:
    where = " > ".join(above) or "the root"
    if isinstance(tree, Mapping):
        pairs = list(tree.items())
    elif isinstance(tree, Sequence) and not isinstance(tree, str):
        pairs = [(name, None) for name in tree]
    else:
        raise FormatError(f"{where} must contain a mapping or a list of names, not {tree!r}")
    for name, children in pairs:
        _check_name(name, where)
        if not children and children is not None and not isinstance(children, Mapping):
            raise FormatError(
                f"{where} contains an empty group '{name}'; leave out the value of a class"
            )
    repeated = _repeated([name for name, _ in pairs])
    if repeated:
        raise FormatError(f"{where} contains {', '.join(repeated)} twice")
    return pairs


def _check_name(name: object, where: str) -> None:
    if not isinstance(name, str) or not name.strip():
        raise FormatError(f"{where} contains {name!r}, which is not a name; put it in quotes")
    fault = name_fault(name)
    if fault is not None:
        raise FormatError(f"{where} contains {name[:MAX_NAME]!r}: {fault}")


def _repeated(names: Sequence[str]) -> list[str]:
    """Return the names that occur more than once after normalisation, sorted."""
    counts = Counter(folded(name) for name in names)
    return sorted(name for name, count in counts.items() if count > 1)
