"""Matching and normalisation of names written by people and language models."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Iterable

LONGEST_LABEL = 60  # characters; longer labels are truncated


class Matcher:
    """Finds the best match of a text in a list of names.

    Exact matches have priority, then matches of letters and digits without case, hyphens and white
    space, then matches without plural endings. Ambiguous matches are rejected, so that "glass" and
    "glasses" remain distinct.
    """

    def __init__(self, names: Iterable[str]) -> None:
        names = tuple(names)
        self._exact = frozenset(names)
        self._keys = [(key, _unambiguous(names, key)) for key in (fold, _stem)]

    def find(self, text: str) -> str | None:
        """Return the matching name, or None."""
        if text in self._exact:
            return text
        for key, table in self._keys:
            if found := table.get(key(text)):
                return found
        return None


def fold(text: str) -> str:
    """Return only the letters and digits in lower case."""
    return "".join(c for c in unicodedata.normalize("NFKC", text).casefold() if c.isalnum())


def clean_label(text: str) -> str:
    """Return a valid group name: one line without '>' and invisible characters; can be empty."""
    kept = (" " if c == ">" or c.isspace() else c for c in text)
    return " ".join("".join(c for c in kept if c.isprintable()).split())[:LONGEST_LABEL].strip()


def distinct(label: str, taken: Iterable[str]) -> str:
    """Return the label, with the first number that makes it distinct from those taken."""
    used = {fold(t) for t in taken}
    candidate, number = label, 2
    while fold(candidate) in used:
        candidate, number = f"{label} {number}", number + 1
    return candidate


def _stem(text: str) -> str:
    """Like `fold`, with the plural endings of all words removed (boxes, knives, candies)."""
    separated = "".join(c if c.isalnum() else " " for c in unicodedata.normalize("NFKC", text))
    return "".join(_stem_word(word) for word in separated.casefold().split())


def _stem_word(word: str) -> str:
    if len(word) > 3 and word.endswith("s") and not word.endswith("ss"):
        word = word[:-1]
    if len(word) > 3 and word.endswith("e"):
        word = word[:-1]
    if word.endswith("y"):
        return word[:-1] + "i"
    return word[:-1] + "f" if word.endswith("v") else word


def _unambiguous(names: tuple[str, ...], key: Callable[[str], str]) -> dict[str, str]:
    """Return a table from key to name without empty and ambiguous keys."""
    table: dict[str, str] = {}
    ambiguous = {""}
    for name in names:
        written = key(name)
        if table.setdefault(written, name) != name:
            ambiguous.add(written)
    return {k: name for k, name in table.items() if k not in ambiguous}
