"""The critic: whatever a grouper says, every item ends in exactly one group (H-III.A.2).

The rules, in the order in which they are applied to an answer:

- an item is found by its name, whatever its case, plural, hyphens or white space; what
  matches nothing was invented and is dropped;
- an item named twice stays where it was named first;
- a group's name loses '>' and what is invisible; equal names are one group; one that is
  called like a class gets "group" after it; a name without a letter or digit is refused with
  its group, and so is, where names are given, any other;
- empty groups do not count; the smallest groups beyond the number allowed are refused;
- one group that holds everything is refused.

What was refused or left out is asked about again, a few times; then the fallback decides.
"""

from __future__ import annotations

from toolkit.taxonomy_building.drafts import ClusterNames, Draft, Groups
from toolkit.taxonomy_building.grouper import (
    Grouper,
    Grouping,
    Question,
    UselessAnswerError,
)
from toolkit.taxonomy_building.repairs import Repairs


def settle(question: Question, grouper: Grouper, fallback: Grouper, rounds: int = 3) -> Grouping:
    """Groups that hold every item of a question exactly once.

    Answers are compared with the question as sets, never by another model. A question with
    clusters keeps its clusters, and takes from the answers only their names. What had to be
    repaired is logged.

    Args:
        grouper: asked first, and again for what it left out.
        fallback: decides what is open after the last round.
        rounds: how often the grouper is asked at most, >= 1.

    Returns:
        At most `most_groups` groups, none empty, their names distinct and fit for a path.
        Given names keep their order; items that of the question. One group alone stands for
        several items only where the fallback, too, sees no difference.

    Raises:
        ValueError: items repeat, or the clusters do not hold each of them once.
        ToolkitError: the grouper can give no answer at all, or the fallback fails.
    """
    _check(question)
    repairs = Repairs()
    draft: Draft = (ClusterNames if question.clusters else Groups)(question, repairs)
    complaint = ""
    for attempt in range(1, rounds + 1):
        if not draft.open_items():
            break
        if attempt > 1:
            repairs.asked_again += draft.open_items()
            # With its number no question repeats: a cache would repeat the answer, too.
            complaint = f"Attempt {attempt} of {rounds}. {complaint}"
        try:
            complaint = draft.add(grouper.group(draft.open_question(), complaint))
        except UselessAnswerError as error:
            repairs.useless.append(str(error))
            complaint = f"Your last answer could not be used: {error}."
    if draft.open_items():
        draft.complete(fallback)
    repairs.log(question)
    return draft.result()


def _check(question: Question) -> None:
    items = sorted(question.items)
    if len(set(items)) != len(items):
        raise ValueError("the items of a question must differ")
    if question.clusters and sorted(i for c in question.clusters for i in c) != items:
        raise ValueError("the clusters of a question must hold each of its items once")
