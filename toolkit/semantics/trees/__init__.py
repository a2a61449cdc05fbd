"""The class trees that come with the package, made by data_tools/make_trees.py."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import resources
from pathlib import Path

from toolkit.errors import FormatError
from toolkit.semantics.taxonomy import VOID_NAME, Taxonomy
from toolkit.semantics.taxonomy_parsing import folded


def shipped_names() -> tuple[str, ...]:
    """Names that `shipped_taxonomy` takes, sorted."""
    files = resources.files(__package__).iterdir()
    return tuple(sorted(f.name.removesuffix(".yaml") for f in files if f.name.endswith(".yaml")))


def shipped_taxonomy(name: str) -> Taxonomy:
    """A shipped tree: "replica" (the synthetic rooms' too), "nyu40", "scannet20", "geometric".

    Class ids are those of the data set.

    Raises:
        FormatError: there is none of that name.
    """
    if name not in shipped_names():
        raise FormatError(
            f"no taxonomy '{name}' is shipped; choose {', '.join(shipped_names())}, or give a file"
        )
    with resources.as_file(resources.files(__package__) / f"{name}.yaml") as path:
        return Taxonomy.load(path)


def taxonomy_named(name_or_path: str | Path) -> Taxonomy:
    """A shipped tree by its name, or else the tree of a file.

    Raises:
        FormatError: neither a shipped name nor a file with a valid tree.
    """
    text = str(name_or_path)
    looks_like_a_file = Path(text).suffix in (".yaml", ".yml", ".json") or Path(text).exists()
    return Taxonomy.load(text) if looks_like_a_file else shipped_taxonomy(text)


def taxonomy_for(classes: Iterable[str]) -> Taxonomy | None:
    """The smallest shipped tree that has all these classes, or None.

    Case, hyphens and spaces do not matter; void is no class.
    """
    wanted = {folded(name) for name in classes} - {VOID_NAME}
    shipped = [shipped_taxonomy(name) for name in shipped_names()]
    covering = [t for t in shipped if wanted and wanted <= {folded(c) for c in t.classes}]
    return min(covering, key=len, default=None)
