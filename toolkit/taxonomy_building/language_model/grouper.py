"""A grouper that asks a language model, long lists in portions."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

from toolkit.taxonomy_building.grouper import Grouping, Question, UselessAnswerError
from toolkit.taxonomy_building.language_model.chat import ChatModel
from toolkit.taxonomy_building.language_model.prompts import read_answer, request_for
from toolkit.taxonomy_building.names import clean_label

logger = logging.getLogger(__name__)

# What is cut off even with so few items is not too long; something else is wrong.
_SMALLEST_PORTION = 8


class LanguageModelGrouper:
    """Asks a chat model; what it answers is for the critic to judge.

    Args:
        model: who is asked.
        seed: sent with every question.
        portion: items of a question at most. Where they are too many for the model they are
            halved until they fit.
        portion_characters: of their names together at most.
    """

    def __init__(
        self, model: ChatModel, seed: int = 0, portion: int = 80, portion_characters: int = 4000
    ) -> None:
        self._model = model
        self._seed = seed
        self._portion = portion
        self._portion_characters = portion_characters

    def group(self, question: Question, complaint: str = "") -> Grouping:
        """Propose groups; for later portions in those of the earlier ones where they fit.

        Raises:
            UselessAnswerError: no portion got a usable answer.
            NoModelError: the model cannot be asked.
        """
        if question.clusters:
            answer = self._model.complete(request_for(question, complaint, (), self._seed))
            return read_answer(question, answer)
        groups: dict[str, tuple[str, ...]] = {}
        trouble: UselessAnswerError | None = None
        waiting = deque(self._portions(question.items))
        while waiting:
            portion = waiting.popleft()
            so_far = tuple(dict.fromkeys(filter(None, map(clean_label, groups))))
            about = _restricted(question, portion, so_far)
            answer = self._model.complete(request_for(about, complaint, so_far, self._seed))
            if answer.ending == "length" and len(portion) >= 2 * _SMALLEST_PORTION:
                logger.info("%d items are too many for %s", len(portion), self._model.identity)
                waiting.extendleft((portion[1::2], portion[::2]))
                continue
            try:
                proposed = read_answer(about, answer)
            except UselessAnswerError as error:
                trouble = error  # the critic asks about these items again
                continue
            for name, items in proposed.items():
                groups[name] = groups.get(name, ()) + items
        if trouble and not groups:
            raise trouble
        return groups

    def _portions(self, items: Sequence[str]) -> list[tuple[str, ...]]:
        """Interleaved, so that the first portion's groups suit the others."""
        characters = sum(map(len, items))
        count = max(-(-len(items) // self._portion), -(-characters // self._portion_characters), 1)
        return [tuple(items[start::count]) for start in range(min(count, len(items)))]


def _restricted(question: Question, items: tuple[str, ...], so_far: tuple[str, ...]) -> Question:
    """The question about some of its items, after groups of others."""
    full = len(so_far) >= question.most_groups and not question.groups
    return replace(question, items=items, groups=so_far if full else question.groups)
