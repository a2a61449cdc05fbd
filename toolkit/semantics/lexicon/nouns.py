"""Indoor nouns with their meanings: a part of WordNet that is shipped with the toolkit.

A meaning is a set of nouns that can replace each other (a synset). Meanings form a graph: a chair
is a kind of seat. `data_tools/make_lexicon.py` made the file from Princeton WordNet 3.1.
"""

from __future__ import annotations

import functools
import gzip
import json
from collections.abc import Iterator, Mapping, Sequence
from importlib import resources

from toolkit.semantics.taxonomy_parsing import folded

_FILE = "nouns.json.gz"

# Meanings beyond the first ones are considered if they are at least this frequent, as a share of
# the most frequent meaning of the noun.
_MIN_SHARE = 0.25

# WordNet's rules for plurals (morphy(7WN)), longest endings first, and irregular indoor nouns.
_ENDINGS = (
    *(("ches", "ch"), ("shes", "sh"), ("ses", "s"), ("xes", "x"), ("zes", "z"), ("men", "man")),
    *(("ies", "y"), ("ves", "f"), ("ves", "fe"), ("es", ""), ("s", "")),
)
_IRREGULAR = {"children": "child", "people": "person", "mice": "mouse", "geese": "goose"}


class Lexicon:
    """Nouns and their meanings, which are numbered from 0.

    Args:
        words: the nouns of each meaning.
        above: numbers of the meanings directly above each one: what it is a kind of.
        senses: for nouns with several meanings, their numbers and frequencies, first ones first.
    """

    def __init__(
        self,
        words: Sequence[Sequence[str]],
        above: Sequence[Sequence[int]],
        senses: Mapping[str, Sequence[tuple[int, int]]],
    ) -> None:
        self._words, self._above = words, above
        self._senses: dict[str, Sequence[tuple[int, int]]] = {}
        for number, nouns in enumerate(words):
            self._senses |= {folded(noun): ((number, 0),) for noun in nouns}
        self._senses |= {folded(noun): found for noun, found in senses.items()}
        # "night stand" and "nightstand" are the same noun.
        self._joined = {noun.replace(" ", ""): noun for noun in reversed(self._senses)}

    def __len__(self) -> int:
        """Number of meanings."""
        return len(self._words)

    def __contains__(self, noun: str) -> bool:
        """Whether a noun is known as it is, not as the plural of another one."""
        return folded(noun) in self._senses

    def meanings(self, noun: str, first: int = 1) -> tuple[int, ...]:
        """Return the likely indoor meanings of a noun, the first one first; empty if unknown.

        Case, hyphens and spaces are ignored, and plurals are found.

        Args:
            noun: the noun.
            first: number of meanings that are returned even if they are rare.
        """
        for form in forms(folded(noun)):
            known = form if form in self._senses else self._joined.get(form.replace(" ", ""))
            if known is not None:
                return _likely(self._senses[known], first)
        return ()

    def nouns(self, meaning: int) -> Sequence[str]:
        """Return the nouns of a meaning."""
        return self._words[meaning]

    @functools.cached_property
    def _kinds(self) -> Sequence[int]:
        counts = [0] * len(self)
        for meaning in range(len(self)):
            for above in self.ancestors(meaning):
                counts[above] += 1
        return counts

    def kinds(self, meaning: int) -> int:
        """Return the number of meanings below one, and itself: general ones have many."""
        return self._kinds[meaning]

    @functools.cache  # noqa: B019 - the lexicon lives as long as the process
    def ancestors(self, meaning: int) -> Mapping[int, int]:
        """Return the meanings above one, and itself, with their numbers of steps."""
        steps = {meaning: 0}
        waiting = [meaning]
        for below in waiting:  # grows: breadth first
            for above in self._above[below]:
                if above not in steps:
                    steps[above] = steps[below] + 1
                    waiting.append(above)
        return steps


def forms(noun: str) -> Iterator[str]:
    """Yield a noun and the singulars that it may be the plural of."""
    yield noun
    start, space, last = noun.rpartition(" ")
    if last in _IRREGULAR:
        yield start + space + _IRREGULAR[last]
    for plural, singular in _ENDINGS:
        if last.endswith(plural) and len(last) > len(plural) + 1 and not last.endswith("ss"):
            yield start + space + last.removesuffix(plural) + singular


@functools.cache
def load_lexicon() -> Lexicon:
    """Return the lexicon that is shipped with the toolkit."""
    packed = resources.files("toolkit.semantics.lexicon").joinpath(_FILE).read_bytes()
    content = json.loads(gzip.decompress(packed))
    return Lexicon(content["words"], content["above"], content["senses"])


def _likely(senses: Sequence[tuple[int, int]], first: int) -> tuple[int, ...]:
    most = max((count for _, count in senses), default=0)
    return tuple(
        number
        for rank, (number, count) in enumerate(senses)
        if rank < first or (count > 0 and count >= _MIN_SHARE * most)
    )
