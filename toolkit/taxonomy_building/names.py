"""Names as people and models write them: found again, and made fit for a tree."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Iterable

LONGEST_LABEL = 60  # characters; a longer one is a sentence and no name


class Matcher:
    """Finds the name that was meant among those asked about.

    Exactly written wins; then the same letters and digits, whatever the case, hyphens and
    white space; then the same but for a plural. A way of writing that two names share finds
    neither: "glass" and "glasses" stay apart.
    """

    def __init__(self, names: Iterable[str]) -> None:
        names = tuple(names)
        self._exact = frozenset(names)
        self._keys = [(key, _unambiguous(names, key)) for key in (fold, _stem)]

    def find(self, text: str) -> str | None:
        """The name, spelled as asked, or None."""
        if text in self._exact:
            return text
        for key, table in self._keys:
            if found := table.get(key(text)):
                return found
        return None


def fold(text: str) -> str:
    """Letters and digits alone, in lower case."""
    return "".join(c for c in unicodedata.normalize("NFKC", text).casefold() if c.isalnum())


def clean_label(text: str) -> str:
    """A group's name fit for a path: one line, no '>', nothing invisible; perhaps empty."""
    kept = (" " if c == ">" or c.isspace() else c for c in text)
    return " ".join("".join(c for c in kept if c.isprintable()).split())[:LONGEST_LABEL].strip()


def distinct(label: str, taken: Iterable[str]) -> str:
    """The label, or it with the first number that makes it differ from those taken."""
    used = {fold(t) for t in taken}
    candidate, number = label, 2
    while fold(candidate) in used:
        candidate, number = f"{label} {number}", number + 1
    return candidate


def _stem(text: str) -> str:
    """Like `fold`, every word without what plurals change (boxes, knives, candies)."""
    apart = "".join(c if c.isalnum() else " " for c in unicodedata.normalize("NFKC", text))
    return "".join(_stem_word(word) for word in apart.casefold().split())


def _stem_word(word: str) -> str:
    if len(word) > 3 and word.endswith("s") and not word.endswith("ss"):
        word = word[:-1]
    if len(word) > 3 and word.endswith("e"):
        word = word[:-1]
    if word.endswith("y"):
        return word[:-1] + "i"
    return word[:-1] + "f" if word.endswith("v") else word


def _unambiguous(names: tuple[str, ...], key: Callable[[str], str]) -> dict[str, str]:
    """From key to name, without the keys that are empty or shared."""
    table: dict[str, str] = {}
    shared = {""}
    for name in names:
        written = key(name)
        if table.setdefault(written, name) != name:
            shared.add(written)
    return {k: name for k, name in table.items() if k not in shared}
