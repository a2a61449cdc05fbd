"""A grouper that uses a language model; long lists are split into portions."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

from toolkit.semantics.taxonomy_building.grouper import Grouping, InvalidAnswerError, Question
from toolkit.semantics.taxonomy_building.language_model.chat import ChatModel
from toolkit.semantics.taxonomy_building.language_model.prompts import read_answer, request_for
from toolkit.semantics.taxonomy_building.names import clean_label

logger = logging.getLogger(__name__)

# Portions are not split below this size, because the answer is then truncated for other reasons.
_MIN_PORTION = 8


class LanguageModelGrouper:
    """Groups items by a chat model; the critic checks the answers.

    Args:
        model: the chat model.
        seed: seed of the sampler, sent with every request.
        portion: maximum number of items per request; it is halved if the answer is truncated.
        portion_characters: maximum number of characters of the names in a request.
    """

    def __init__(
        self, model: ChatModel, seed: int = 0, portion: int = 80, portion_characters: int = 4000
    ) -> None:
        self._model = model
        self._seed = seed
        self._portion = portion
        self._portion_characters = portion_characters

    def group(self, question: Question, complaint: str = "") -> Grouping:
        """Propose groups; later portions use the groups of earlier ones where appropriate.

        Raises:
            InvalidAnswerError: all answers are unusable.
            NoModelError: the model is not available.
        """
        if question.clusters:
            answer = self._model.complete(request_for(question, complaint, (), self._seed))
            return read_answer(question, answer)
        groups: dict[str, tuple[str, ...]] = {}
        last_error: InvalidAnswerError | None = None
        waiting = deque(self._portions(question.items))
        while waiting:
            portion = waiting.popleft()
            so_far = tuple(dict.fromkeys(filter(None, map(clean_label, groups))))
            about = _restricted(question, portion, so_far)
            answer = self._model.complete(request_for(about, complaint, so_far, self._seed))
            if answer.ending == "length" and len(portion) >= 2 * _MIN_PORTION:
                logger.info(
                    "Answer of %s for %d items was truncated; splitting the request.",
                    self._model.identity,
                    len(portion),
                )
                waiting.extendleft((portion[1::2], portion[::2]))
                continue
            try:
                proposed = read_answer(about, answer)
            except InvalidAnswerError as error:
                last_error = error  # the critic asks about these items again
                continue
            for name, items in proposed.items():
                groups[name] = groups.get(name, ()) + items
        if last_error and not groups:
            raise last_error
        return groups

    def _portions(self, items: Sequence[str]) -> list[tuple[str, ...]]:
        """Return interleaved portions, so that the groups of the first one suit the others."""
        characters = sum(map(len, items))
        count = max(-(-len(items) // self._portion), -(-characters // self._portion_characters), 1)
        return [tuple(items[start::count]) for start in range(min(count, len(items)))]


def _restricted(question: Question, items: tuple[str, ...], so_far: tuple[str, ...]) -> Question:
    """Restrict a question to some items, given the groups of earlier portions."""
    full = len(so_far) >= question.max_groups and not question.groups
    return replace(question, items=items, groups=so_far if full else question.groups)
