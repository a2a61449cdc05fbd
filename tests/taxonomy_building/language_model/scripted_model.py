"""A scripted language model: it groups by the built-in rules and makes the errors of real models.

Errors are drawn from a seed, the text of the request and the number of times it was sent, so that
runs are reproducible and a repeated request can succeed.
"""

from __future__ import annotations

import json
import re
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np
from chat_server import (
    Behaviour,
    Groups,
    Response,
    as_text,
    clusters_of,
    fails,
    items_of,
)

from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_building.builder import build_taxonomy
from toolkit.semantics.taxonomy_building.grouper import Aspect, Question
from toolkit.semantics.taxonomy_building.language_model.chat import (
    ChatAnswer,
    ChatRequest,
    ModelIdentity,
)
from toolkit.semantics.taxonomy_building.language_model.grouper import LanguageModelGrouper
from toolkit.semantics.taxonomy_building.rules import RuleGrouper

# Per item of an answer.
ItemError = Literal["invented", "omitted", "duplicated", "renamed"]
# Per answer.
AnswerError = Literal["prose", "fence", "invalid JSON", "refused", "truncated"]
# Per request: no answer arrives.
TransportError = Literal["time-out", "slow", "dropped", "429", "500"]
Kind = ItemError | AnswerError | TransportError

ITEM_ERRORS: tuple[ItemError, ...] = get_args(ItemError)
ANSWER_ERRORS: tuple[AnswerError, ...] = get_args(AnswerError)
TRANSPORT_ERRORS: tuple[TransportError, ...] = get_args(TransportError)
KINDS: tuple[Kind, ...] = (*ITEM_ERRORS, *ANSWER_ERRORS, *TRANSPORT_ERRORS)

# Time limit of a request to the scripted model; late answers need a multiple of it.
TIMEOUT_S = 0.5

_ASPECTS: dict[str, Aspect] = {
    "physical size": "size",
    "what they are for": "function",
    "by their shape": "geometry",
}


class ScriptedModel:
    """Answers requests of `LanguageModelGrouper`.

    Args:
        rates: probability of each error: per item, per answer or per request, see the types.
        seed: seed of the errors.

    Attributes:
        errors: number of errors made, by kind.
    """

    def __init__(self, rates: Mapping[Kind, float], seed: int = 0) -> None:
        self.errors: Counter[Kind] = Counter()
        self._rates = rates
        self._seed = seed
        self._sent: Counter[int] = Counter()

    def __call__(self, request: dict[str, Any]) -> Response:
        """Return the response to a request."""
        key = zlib.crc32(request["messages"][1]["content"].encode())
        self._sent[key] += 1
        rng = np.random.default_rng([self._seed, key, self._sent[key]])
        for kind in TRANSPORT_ERRORS:
            if self._errs(kind, rng):
                return _undelivered(kind, request)
        clusters = clusters_of(request)
        if clusters:
            names = RuleGrouper().group(_question(request, clusters))
            listed = [{"number": n, "name": name} for n, name in enumerate(names, start=1)]
            return self._said(json.dumps({"groups": listed}), rng)
        groups = self._with_wrong_items(_right_groups(request), rng)
        return self._said(as_text(groups), rng)

    def _errs(self, kind: Kind, rng: np.random.Generator) -> bool:
        # One number per kind, so that the rate of one does not change the errors of another.
        made = bool(rng.random() < self._rates.get(kind, 0.0))
        self.errors[kind] += made
        return made

    def _with_wrong_items(self, groups: Groups, rng: np.random.Generator) -> Groups:
        answered: Groups = {name: [] for name in groups}
        for name, items in groups.items():
            for item in items:
                invented, omitted, duplicated, renamed = (self._errs(k, rng) for k in ITEM_ERRORS)
                written = _renamed(item, rng) if renamed else item
                if not omitted:
                    answered[name].append(written)
                if duplicated:
                    answered[str(rng.choice([*groups]))].append(written)
                if invented:
                    answered[name].append(f"{item} of another scene")
        return answered

    def _said(self, text: str, rng: np.random.Generator) -> Response:
        """Return an answer as message, with the errors of its form."""
        prose, fence, invalid, refused, cut = (self._errs(k, rng) for k in ANSWER_ERRORS)
        if refused:
            return Response("", refusal="I cannot help with that.")
        if invalid:  # a bracket or quotation mark is missing
            marks = [place for place, letter in enumerate(text) if letter in '[]{}"']
            place = marks[rng.integers(len(marks))]
            text = text[:place] + text[place + 1 :]
        if fence:
            text = f"```json\n{text}\n```"
        if prose:
            text = f"Sure, here are {{sensible}} groups:\n{text}\nShall I refine [some] of them?"
        if cut:
            return Response(text[: rng.integers(len(text))], finish="length")
        return Response(text)


def _undelivered(kind: TransportError, request: dict[str, Any]) -> Response:
    broken: dict[TransportError, Behaviour] = {
        "time-out": lambda _: Response("late", delay_s=2 * TIMEOUT_S),
        # The bytes arrive steadily, but not in time.
        "slow": lambda _: Response(body=" " * 40, trickle_s=0.05 * TIMEOUT_S),
        "dropped": lambda _: Response("half of an answer", dropped=True),
        "429": fails(429, "rate limit reached", Retry_After="0"),
        "500": fails(500, "internal error"),
    }
    return broken[kind](request)


def _question(request: dict[str, Any], clusters: list[list[str]] | None = None) -> Question:
    """Read the question from the text of a request, as a model does."""
    system, user = (message["content"] for message in request["messages"])
    aspects = [aspect for words, aspect in _ASPECTS.items() if words in user]
    found = re.search(r"at most (\d+)", system)
    if clusters:
        items = tuple(item for cluster in clusters for item in cluster)
        return Question(items, "geometry", clusters=tuple(map(tuple, clusters)))
    given = re.search(r"no other names for groups than (\[.*\])\.", user)
    names = tuple(json.loads(given[1])) if given else ()
    most = int(found[1]) if found else len(names)
    return Question(tuple(items_of(request)), aspects[0], groups=names, max_groups=most)


def _right_groups(request: dict[str, Any]) -> Groups:
    """Group by the rules; use the groups that a request names where they fit."""
    question = _question(request)
    groups = {name: list(items) for name, items in RuleGrouper().group(question).items()}
    user = request["messages"][1]["content"]
    so_far = re.search(r"(?:groups already|Groups so far): (\[.*?\])\. Use", user)
    known = json.loads(so_far[1]) if so_far else []
    if question.groups or not known:
        return groups
    free = question.max_groups - len(known)
    kept: Groups = {}
    for name, items in groups.items():
        if name in known or free > 0:
            kept[name] = items
            free -= name not in known
            continue
        among = Question(tuple(items), question.aspect, groups=tuple(known))
        for other, members in RuleGrouper().group(among).items():
            kept[other] = [*kept.get(other, []), *members]
    return kept


def _renamed(item: str, rng: np.random.Generator) -> str:
    """Write an item differently: 'night stand' for 'nightstand', plural, capitals, or a synonym."""
    middle = len(item) // 2
    ways = (
        f"{item[:middle]} {item[middle:]}",
        item.replace(" ", "-").title(),
        item.replace(" ", ""),
        f"{item}s",
        f"ordinary {item}",  # not recognised
        item[1:] + item[0],  # not recognised
    )
    return str(ways[rng.integers(len(ways))])


def scripted_tree(classes: Sequence[str], rate: float = 0.1, seed: int = 0) -> Taxonomy:
    """Build a tree by a scripted model that makes every error of items and answers at a rate.

    The model is called in this process, since its answers all arrive.
    """
    return build_taxonomy(classes, LanguageModelGrouper(ScriptedChat(rate, seed)))


class ScriptedChat:
    """A scripted model without a server, with every error of items and answers at a rate."""

    identity = ModelIdentity("http://127.0.0.1/v1", "scripted")

    def __init__(self, rate: float = 0.1, seed: int = 0) -> None:
        self._model = ScriptedModel(dict.fromkeys((*ITEM_ERRORS, *ANSWER_ERRORS), rate), seed)

    def complete(self, request: ChatRequest) -> ChatAnswer:
        """Return the answer of the model."""
        messages = [{"content": request.system}, {"content": request.user}]
        response = self._model({"messages": messages})
        if response.refusal:
            return ChatAnswer("", "refused")
        return ChatAnswer(response.text or "", "length" if response.finish == "length" else "stop")
