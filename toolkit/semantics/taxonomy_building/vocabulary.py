"""The built-in vocabulary: function, size and shape of an object by its name."""

from __future__ import annotations

import difflib
import functools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

# Neighbouring shapes are the most similar.
SHAPES = ("flat", "long", "tall", "boxy", "legged", "round", "hollow", "soft", "irregular")


@dataclass(frozen=True)
class Entry:
    """Properties of a kind of object.

    Attributes:
        word: word or phrase of the vocabulary, singular.
        function: names of groups from the most general to the most specific.
        size_m: typical length of the longest side in metres.
        shape: one of SHAPES.
    """

    word: str
    function: tuple[str, ...]
    size_m: float
    shape: str


UNKNOWN = Entry("", ("other",), 0.5, "irregular")


def _set(words: str) -> frozenset[str]:
    return frozenset(words.split())


# Words of quantity: "stack of books" is looked up as "books", but "bottle of water" as "bottle".
_QUANTITIES = _set("set pair stack pile bunch group roll sheet piece deck row heap pack bundle lot")
_PREPOSITIONS = _set("for with without on in at from and by to under over near w or")
# Parts and accessories take the function of their object: soap holder and soap.
_HELPERS = _set(
    """accessory base button case cover dispenser equipment frame handle holder item kit leg lever
    lid liner machine object part product protector rod stuff supply thing top topper"""
)
_TOYS = _set("toy stuffed plush lego inflatable doll miniature")
_SCALES = {
    **dict.fromkeys(_set("small mini tiny little compact portable pocket"), 0.6),
    **dict.fromkeys(_set("large big giant huge oversized industrial"), 1.5),
}
# Rooms and activities, which indicate the function of an unknown object.
_PLACES = {
    "kitchen": "spatula",
    "cooking": "spatula",
    "bathroom": "soap",
    "toilet": "soap",
    "laundry": "detergent",
    "cleaning": "detergent",
    "garden": "garden tool",
    "office": "stapler",
    "baby": "toy",
    "sport": "ball",
    "gym": "ball",
    "music": "musical instrument",
    "electric": "device",
    "electronic": "device",
    "wireless": "device",
    "pet": "pet bed",
}
_IRREGULAR = {
    "children": "child",
    "dice": "die",
    "feet": "foot",
    "geese": "goose",
    "men": "man",
    "mice": "mouse",
    "women": "woman",
    "leaves": "leaf",
}
_BRACKETS = re.compile(r"\(([^)]*)\)")
_MIN_ENDING = 4  # minimum length of the ending of a compound: "shelf" in "bookshelf"
_MIN_MISSPELT = 6  # minimum length of a word that is compared with misspellings
_SIMILAR = 0.88  # minimum similarity of misspellings, as difflib measures it


class ObjectVocabulary:
    """Known objects, and the look-up of names.

    Args:
        tree: nested functions; a leaf maps "metres shape" to words separated by commas.
    """

    def __init__(self, tree: Mapping[str, Any]) -> None:
        self._entries = {_squeezed(e.word): e for e in _entries(tree, ())}
        self._spellings = _Spellings(list(self._entries))
        # A name is looked up for every question about it.
        self._found: dict[str, Entry] = {}
        # In the order of the file; related functions are neighbours.
        self.functions = tuple(dict.fromkeys(e.function for e in self._entries.values()))

    def __len__(self) -> int:
        return len(self._entries)

    def __iter__(self) -> Iterator[Entry]:
        return iter(self._entries.values())

    def look_up(self, name: str) -> Entry:
        """Return the entry of a name, or UNKNOWN.

        Case, hyphens, plurals and numbers are ignored. The look-up tries in turn: the longest known
        ending ("tall office chair"), the ending of a compound ("bookshelf"), a misspelling, any
        word of the name, any word in brackets ("quiche (food)").
        """
        if name not in self._found:
            self._found[name] = self._look_up(name)
        return self._found[name]

    def _look_up(self, name: str) -> Entry:
        words = _words(name)
        found = self._exact(words)
        if found:
            return found
        words = _head(words)
        for start in range(len(words)):
            found = self._exact(words[start:])
            if found:
                return self._qualified(found, words[:start])
        return (
            self._compound(words)
            or self._misspelt(words)
            or self._mentioned(words)
            or self._mentioned(_words(" ".join(_BRACKETS.findall(name))))
            or UNKNOWN
        )

    def _exact(self, words: Sequence[str]) -> Entry | None:
        if not words:
            return None
        front = "".join(words[:-1])
        for last in _singulars(words[-1]):
            if front + last in self._entries:
                return self._entries[front + last]
        return None

    def _qualified(self, entry: Entry, before: Sequence[str]) -> Entry:
        """Return the entry of the last words, modified by the words before them."""
        for word in before:
            entry = replace(entry, size_m=entry.size_m * _SCALES.get(word, 1.0))
        if not _TOYS.isdisjoint(before):
            toy = self._entries["toy"]
            return replace(entry, function=toy.function, size_m=min(entry.size_m, toy.size_m))
        if entry.word in _HELPERS:
            owner = self._mentioned(before)
            if owner:
                return replace(entry, function=owner.function)
        return entry

    def _compound(self, words: Sequence[str]) -> Entry | None:
        if not words:
            return None
        for last in _singulars(words[-1]):
            for start in range(3, len(last) - _MIN_ENDING + 1):
                if last[start:] in self._entries:
                    return self._qualified(self._entries[last[start:]], words[:-1])
        return None

    def _misspelt(self, words: Sequence[str]) -> Entry | None:
        if not words or len(words[-1]) < _MIN_MISSPELT:
            return None
        close = self._spellings.closest(words[-1])
        return self._qualified(self._entries[close], words[:-1]) if close else None

    def _mentioned(self, words: Sequence[str]) -> Entry | None:
        """Return the entry of the last known word, with unknown shape and limited size."""
        for end in range(len(words), 0, -1):
            for start in range(end):
                place = _PLACES.get(words[start]) if start == end - 1 else None
                found = self._exact(words[start:end]) or (self._exact([place]) if place else None)
                if found:
                    size_m = min(found.size_m, UNKNOWN.size_m)
                    return replace(found, size_m=size_m, shape=UNKNOWN.shape)
        return None


class _Spellings:
    """Words, and which of them is spelt like another one.

    Comparing a word with all of them takes milliseconds; most share too few letters.
    """

    def __init__(self, words: list[str]) -> None:
        self._words, self._letters = words, sorted(set("".join(words)))
        self._counts = np.array([self._counts_of(word) for word in words])
        self._lengths = np.array([len(word) for word in words])

    def closest(self, word: str) -> str | None:
        """The most similar word, None if no word is similar."""
        if not self._words:
            return None
        shared = np.minimum(self._counts, self._counts_of(word)).sum(axis=1)
        is_near = 2.0 * shared >= (_SIMILAR - 1e-6) * (self._lengths + len(word))
        near = [self._words[index] for index in np.flatnonzero(is_near)]
        return next(iter(difflib.get_close_matches(word, near, n=1, cutoff=_SIMILAR)), None)

    def _counts_of(self, word: str) -> NDArray[np.int16]:
        return np.array([word.count(letter) for letter in self._letters], np.int16)


@functools.cache
def built_in() -> ObjectVocabulary:
    """Load the vocabulary of the package."""
    text = resources.files(__package__).joinpath("vocabulary.yaml").read_text("utf-8")
    return ObjectVocabulary(yaml.safe_load(text))


def _entries(tree: Mapping[str, Any], above: tuple[str, ...]) -> Iterator[Entry]:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _entries(value, (*above, key))
        else:
            size_m, shape = key.split()
            for word in value.split(","):
                yield Entry(word.strip(), above, float(size_m), shape)


def _words(name: str) -> list[str]:
    """Return the words in lower case, without numbers and text in brackets."""
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)
    spaced = _BRACKETS.sub(" ", spaced).replace("'", "")
    words = re.findall(r"[^\W_]+", spaced.casefold())
    return [word for word in words if not word.isdigit()]


def _head(words: list[str]) -> list[str]:
    """Return the words that end with the object: those before "for" or "with", around "of"."""
    if "of" in words[1:-1]:
        of = words.index("of", 1)
        counted = _QUANTITIES.intersection(_singulars(words[of - 1]))
        return _head(words[of + 1 :] if counted else words[:of])
    for number, word in enumerate(words):
        if number and word in _PREPOSITIONS:
            return words[:number]
    return words


def _singulars(word: str) -> list[str]:
    """Return the word and its possible singulars, most likely first."""
    found = [word]
    if word in _IRREGULAR:
        found.append(_IRREGULAR[word])
    if word.endswith("ies"):
        found.append(word[:-3] + "y")
    if word.endswith("ves"):
        found += [word[:-3] + "f", word[:-3] + "fe"]
    if word.endswith("s") and not word.endswith("ss"):
        found.append(word[:-1])
    if word.endswith("es"):
        found.append(word[:-2])
    return found


def _squeezed(phrase: str) -> str:
    return phrase.replace(" ", "")
