"""Words of a user matched with the nodes of a taxonomy: exact names first, then by meaning."""

from __future__ import annotations

import functools
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from toolkit.base.errors import FormatError
from toolkit.semantics.lexicon.nouns import Lexicon, forms, load_lexicon
from toolkit.semantics.taxonomy import Node, Taxonomy
from toolkit.semantics.taxonomy_parsing import folded

MAX_QUERY = 200  # characters
# Steps from a word up to a class, and from a word to a class over a common meaning (suggestions).
_MAX_UP, _MAX_ACROSS = 6, 4
# A common meaning of suggestions is not as general as "device", which has hundreds of kinds.
_MAX_KINDS = 300
_SUGGESTIONS = 3
_MAX_LISTED = 8
LIST_CLASSES = "list its classes with: semsplat query RUN --list"
# Of a word of the user, this many meanings are considered even if they are rare.
_FIRST_MEANINGS = 2

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Match:
    """The nodes that a text means.

    Attributes:
        text: the text.
        nodes: nodes of the taxonomy; none is below another.
        explanation: why these nodes, one line; None if the text is the name of the only node.
        wider: whether the nodes include things that the text excludes, as all cups for "red mug".
    """

    text: str
    nodes: tuple[Node, ...]
    explanation: str | None = None
    wider: bool = False


@dataclass(frozen=True)
class _Found:
    """Nodes for one meaning of a word; `relation` is 0 if they mean the same, 1 for kinds of the
    word, 2 for what the word is a kind of."""

    relation: int
    nodes: tuple[Node, ...]


def match(
    text: str, taxonomy: Taxonomy, lexicon: Lexicon | None = None, remedy: str = LIST_CLASSES
) -> Match:
    """Return the nodes that a text means.

    These are, in this order: the node of this name or path; the node of this name in the singular;
    classes that mean the same; classes that are kinds of it; the classes that it is a kind of. If
    the lexicon does not contain the text, its first words are left out: "red mug" becomes "mug".

    Args:
        text: a name, a path such as "furniture > chair", or a noun.
        taxonomy: the tree.
        lexicon: nouns and their meanings; by default, those shipped with the toolkit.
        remedy: how to list the classes, for errors.

    Raises:
        FormatError: nothing matches, or several things do; the message lists what is near.
    """
    if taxonomy.find_all(text):
        return Match(text, (taxonomy.find(text),))
    check_query(text)
    if ">" in text:
        return _named(text, taxonomy, remedy)
    lexicon = lexicon or load_lexicon()
    for noun in _endings(folded(text)):
        named = [name for name in forms(noun) if taxonomy.find_all(name)]
        # Clothes are not the plural of cloth.
        if named and (noun == named[0] or noun not in lexicon):
            node = taxonomy.find(named[0])
            reason = f"no class is called '{text}'; searched for '{node.name}'"
            return Match(text, (node,), reason, wider=noun != folded(text))
        meanings = lexicon.meanings(noun, _FIRST_MEANINGS)
        if meanings:
            found = [f for f in (_nodes_of(m, taxonomy, lexicon) for m in meanings) if f]
            if not found:
                reason = _unmatched(text, noun, meanings, taxonomy, lexicon)
                raise FormatError(f"{reason}; {remedy}")
            return _by_meaning(text, noun, found)
    return _named(text, taxonomy, remedy)


def _named(text: str, taxonomy: Taxonomy, remedy: str) -> Match:
    """Return the match of a name."""
    try:
        return Match(text, (taxonomy.find(text),))
    except FormatError as error:
        raise FormatError(
            str(error) if str(error).endswith("?") else f"{error}; {remedy}"
        ) from None


def selected_nodes(
    names: Sequence[str], taxonomy: Taxonomy, remedy: str = LIST_CLASSES
) -> list[Node]:
    """Return the nodes that names and nouns select, for programs that change what they select.

    Unlike `match`, which finds the nearest classes, it never selects more than the text means:
    an armchair does not select all chairs. Explanations of matches by meaning are logged.

    Args:
        names: names, paths or nouns.
        taxonomy: the tree.
        remedy: how to list the classes, for errors.

    Raises:
        FormatError: as `match`; or classes include a text, but also other things.
    """
    found: list[Node] = []
    for name in names:
        meant = match(name, taxonomy, remedy=remedy)
        if meant.wider:
            nodes = _listed([node.name for node in meant.nodes], "or")
            raise FormatError(f"{meant.explanation}; to select more than '{name}', give {nodes}")
        if meant.explanation is not None:
            _log.info("%s.", meant.explanation[0].upper() + meant.explanation[1:])
        found += meant.nodes
    return found


def check_query(text: str) -> None:
    """Check the length of a text.

    Raises:
        FormatError: it is empty or too long.
    """
    if len(text) > MAX_QUERY:
        raise FormatError(
            f"the query '{text[:20]}...' has {len(text)} characters; give at most {MAX_QUERY}"
        )
    if not text.strip():
        raise FormatError("the query is empty; give the name of a class, or a noun")


def _by_meaning(text: str, noun: str, found: Sequence[_Found]) -> Match:
    """Return the match of a noun, the whole text or its last words, from its meanings."""
    relation = min(f.relation for f in found)
    best = [f.nodes for f in found if f.relation == relation]
    # Related meanings have classes in common, as an appliance for the home and one in general.
    nodes = best[0]
    for others in best[1:]:
        if not set(nodes) & set(others):
            several = " or ".join(_listed([n.name for n in part]) for part in (nodes, others))
            raise FormatError(f"'{text}' may mean {several}; give one of these names")
        nodes = _distinct([*nodes, *others])
    names = _listed([n.name for n in nodes], "or" if relation == 2 else "and")
    subject = "it" if noun == folded(text) else f"'{noun}'"
    verb = "mean" if len(nodes) > 1 else "means"
    reason = (
        f"{names} {verb} the same" if noun == folded(text) else f"{names} {verb} {subject}",
        f"{subject} includes {names}",
        f"{subject} is a kind of {names}",
    )[relation]
    wider = relation == 2 or noun != folded(text)
    return Match(text, nodes, f"no class is called '{text}'; {reason} (lexicon)", wider)


def _nodes_of(meaning: int, taxonomy: Taxonomy, lexicon: Lexicon) -> _Found | None:
    """Return the nodes that one meaning of a word matches."""
    known = _meanings_of_nodes(taxonomy, lexicon)
    leaves = [(node, m) for node, found in known for m in found if node.leaf]
    groups = [(node, m) for node, found in known for m in found if not node.leaf]
    above = lexicon.ancestors(meaning)
    for pairs in (leaves, groups):
        same = [node for node, m in pairs if m == meaning and _is_full_name(node, lexicon)]
        if same:
            return _Found(0, _distinct(same))
    kinds = [node for node, m in leaves if meaning in lexicon.ancestors(m)]
    if kinds:
        return _Found(1, _distinct(kinds))
    steps = [above.get(m, _MAX_UP + 1) for _, m in leaves]
    nearest = min(steps, default=_MAX_UP + 1)
    if nearest <= _MAX_UP:
        near = [node for (node, _), step in zip(leaves, steps, strict=True) if step == nearest]
        return _Found(2, _distinct(near))
    return None


@functools.lru_cache(maxsize=8)
def _meanings_of_nodes(
    taxonomy: Taxonomy, lexicon: Lexicon
) -> tuple[tuple[Node, tuple[int, ...]], ...]:
    """Return the meanings of the name of each node, or of its last words: a base cabinet is a
    cabinet. Of groups, only whole and unique names are used; others are often adjectives."""
    found = []
    for node in taxonomy.nodes:
        if node.leaf:
            named = (lexicon.meanings(noun) for noun in _endings(folded(node.name)))
            found.append((node, next(filter(None, named), ())))
        elif len(taxonomy.find_all(node.name)) == 1:
            found.append((node, lexicon.meanings(node.name)))
    return tuple(found)


def _is_full_name(node: Node, lexicon: Lexicon) -> bool:
    return bool(lexicon.meanings(node.name))


def _unmatched(
    text: str, noun: str, meanings: Sequence[int], taxonomy: Taxonomy, lexicon: Lexicon
) -> str:
    """Return the message for a known word that matches no class."""
    steps: dict[str, int] = {}
    for meaning in meanings:
        above = lexicon.ancestors(meaning)
        for node, found in _meanings_of_nodes(taxonomy, lexicon):
            for other in found if node.leaf else ():
                theirs = lexicon.ancestors(other)
                common = (m for m in above.keys() & theirs if lexicon.kinds(m) <= _MAX_KINDS)
                across = [above[m] + theirs[m] for m in common]
                steps[node.name] = min([*across, steps.get(node.name, _MAX_ACROSS + 1)])
    near = sorted((n for n, step in steps.items() if step <= _MAX_ACROSS), key=steps.__getitem__)
    hint = f"; near in meaning: {_listed(near[:_SUGGESTIONS])}" if near else ""
    searched = "" if noun == folded(text) else f" (searched for '{noun}')"
    return f"no class or group of taxonomy '{taxonomy.name}' means '{text}'{searched}{hint}"


def _endings(noun: str) -> Iterator[str]:
    """Yield a phrase, then without its first words: in English, the last word is the thing."""
    words = noun.split()
    yield from (" ".join(words[first:]) for first in range(len(words)))


def _distinct(nodes: Sequence[Node]) -> tuple[Node, ...]:
    return tuple(dict.fromkeys(nodes))


def _listed(names: Sequence[str], word: str = "and") -> str:
    quoted = [f"'{name}'" for name in names]
    if len(quoted) > _MAX_LISTED:
        return ", ".join(quoted[:_MAX_LISTED]) + f" {word} {len(quoted) - _MAX_LISTED} more"
    return ", ".join(quoted[:-1]) + (f" {word} " if len(quoted) > 1 else "") + quoted[-1]
