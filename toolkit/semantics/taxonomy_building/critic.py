"""The critic corrects the answers of groupers: every item is in exactly one group (H-III.A.2).

The rules in the order of their application:

- items are matched by name without case, plural, hyphens and white space; items without a match
  are dropped;
- an item that is named twice remains in the first group;
- '>' and invisible characters are removed from the names of groups; groups of equal names are
  merged; "group" is appended to names of classes; groups without a letter or digit in their name
  are rejected, and if the question gives names, groups with other names;
- empty groups are ignored; the smallest groups above the maximum number are rejected;
- a single group with all items is rejected.

Items that were rejected or left out are asked about again, for a limited number of rounds. The
fallback decides on the remaining ones.
"""

from __future__ import annotations

from toolkit.semantics.taxonomy_building.drafts import ClusterNames, Draft, Groups
from toolkit.semantics.taxonomy_building.grouper import (
    Grouper,
    Grouping,
    InvalidAnswerError,
    Question,
)
from toolkit.semantics.taxonomy_building.repairs import Repairs


def settle(question: Question, grouper: Grouper, fallback: Grouper, rounds: int = 3) -> Grouping:
    """Return groups that contain every item of a question exactly once.

    Answers are compared with the question as sets, without another model. Clusters of a question
    are kept, only their names are taken from the answers. Corrections are logged.

    Args:
        question: the items and the criterion.
        grouper: asked first, and again for missing items.
        fallback: decides on the items that are open after the last round.
        rounds: maximum number of calls of the grouper, >= 1.

    Returns:
        At most `max_groups` non-empty groups with distinct, valid names. Given names keep their
        order, and items the order of the question. A single group contains several items only
        if the fallback does not distinguish them either.

    Raises:
        ToolkitError: the grouper is not available, or the fallback fails.
    """
    repairs = Repairs()
    draft: Draft = (ClusterNames if question.clusters else Groups)(question, repairs)
    complaint = ""
    for attempt in range(1, rounds + 1):
        if not draft.open_items():
            break
        if attempt > 1:
            repairs.asked_again += draft.open_items()
            # The attempt number makes questions distinct, so that a cache does not repeat answers.
            complaint = f"Attempt {attempt} of {rounds}. {complaint}"
        try:
            complaint = draft.add(grouper.group(draft.open_question(), complaint))
        except InvalidAnswerError as error:
            repairs.invalid.append(str(error))
            complaint = f"Your last answer could not be used: {error}."
    if draft.open_items():
        draft.complete(fallback)
    repairs.log(question)
    return draft.result()
