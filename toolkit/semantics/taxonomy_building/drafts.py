"""Partial answers: the groups accepted by the critic so far, and the open items."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Protocol

from toolkit.semantics.taxonomy import VOID_NAME
from toolkit.semantics.taxonomy_building.grouper import Grouper, Grouping, Question
from toolkit.semantics.taxonomy_building.names import Matcher, clean_label, distinct, fold
from toolkit.semantics.taxonomy_building.repairs import Repairs


class Draft(Protocol):
    """A partial answer to a question."""

    def open_items(self) -> list[str]:
        """Return the items without a group, in the order of the question."""
        ...

    def open_question(self) -> Question:
        """Return the question restricted to the open items."""
        ...

    def add(self, answer: Grouping) -> str:
        """Accept the valid part of an answer; return a complaint about the rest."""
        ...

    def complete(self, fallback: Grouper) -> None:
        """Complete the open items with the fallback."""
        ...

    def result(self) -> Grouping:
        """Return the groups; requires that no items are open."""
        ...


class Groups:
    """Groups for a question without clusters."""

    def __init__(self, question: Question, repairs: Repairs) -> None:
        self._question = question
        self._repairs = repairs
        self._matcher = Matcher(question.items)
        self._labels = _Labels(question, repairs)
        self._group_of: dict[str, str] = {}

    def open_items(self) -> list[str]:
        return [item for item in self._question.items if item not in self._group_of]

    def open_question(self) -> Question:
        """See `Draft`; restricts the names to the existing groups if no more are permitted."""
        so_far = self._so_far()
        full = len(so_far) >= self._question.max_groups
        groups = tuple(so_far) if full else self._question.groups
        return replace(self._question, items=tuple(self.open_items()), groups=groups)

    def add(self, answer: Grouping) -> str:
        surplus = self._keep(self._proposed(answer))
        if self._is_undivided() and not self.open_items():
            self._repairs.undivided += 1
            self._group_of = {}
            return "Your last answer put everything in one group: make at least two."
        if surplus:
            problem = "Your last answer made more groups than are allowed."
        else:
            problem = "Your last answer left out these items, or used names that were not given."
        so_far = json.dumps(self._so_far(), ensure_ascii=False)
        return f"{problem} Groups so far: {so_far}. Use these names where they fit."

    def complete(self, fallback: Grouper) -> None:
        """Group all items by the fallback; assign open items like those in the same group."""
        repairs = Repairs()  # corrections of the fallback are not reported
        alone = Groups(self._question, repairs)
        alone._keep(alone._proposed(fallback.group(self._question)))
        opinions = {i: self._labels.use(g) or g for i, g in alone._group_of.items()}
        self._repairs.by_fallback += self.open_items()
        self._fill(opinions)
        if self._is_undivided() and len(set(opinions.values())) > 1:
            self._group_of = {}
            self._fill(opinions)

    def result(self) -> Grouping:
        order = self._question.groups or self._so_far()
        grouped = {
            label: tuple(i for i in self._question.items if self._group_of[i] == label)
            for label in order
        }
        return {label: items for label, items in grouped.items() if items}

    def _proposed(self, answer: Grouping) -> dict[str, list[str]]:
        """Return the groups of the answer by their final names, restricted to open items."""
        proposed: dict[str, list[str]] = {}
        seen = set(self._group_of)
        for written_label, written_items in answer.items():
            label = self._labels.use(written_label)
            for written in written_items:
                item = self._matcher.find(written)
                if item is None:
                    self._repairs.invented.append(written)
                elif item in seen:
                    self._repairs.repeated.append(item)
                elif label is not None:
                    seen.add(item)
                    proposed.setdefault(label, []).append(item)
                    if written != item:
                        self._repairs.renamed.append(f"{written} -> {item}")
        return proposed

    def _keep(self, proposed: Mapping[str, Sequence[str]]) -> list[str]:
        """Accept groups up to the maximum number, largest first; return the rejected ones."""
        so_far = self._so_far()
        new = sorted((g for g in proposed if g not in so_far), key=lambda g: -len(proposed[g]))
        surplus = new[self._question.max_groups - len(so_far) :]
        self._repairs.surplus += surplus
        for label, items in proposed.items():
            if label not in surplus:
                self._group_of |= dict.fromkeys(items, label)
        return surplus

    def _is_undivided(self) -> bool:
        return len(self._so_far()) == 1 and len(self._question.items) > 1

    def _so_far(self) -> list[str]:
        """Return the groups in the order in which they were added."""
        return list(dict.fromkeys(self._group_of.values()))

    def _fill(self, opinions: Mapping[str, str]) -> None:
        # Items without an opinion are last, so that they are assigned to existing groups.
        for item in sorted(self.open_items(), key=lambda i: i not in opinions):
            self._group_of[item] = self._place(opinions.get(item), opinions)

    def _place(self, opinion: str | None, opinions: Mapping[str, str]) -> str:
        """Return the group of an item, given the fallback's opinion on it or None."""
        sizes = Counter(self._group_of.values())
        if opinion is not None:
            if opinion in sizes:
                return opinion
            related = Counter(g for i, g in self._group_of.items() if opinions.get(i) == opinion)
            if related and not self._question.groups:
                return related.most_common(1)[0][0]
            if len(sizes) < self._question.max_groups:
                return opinion
        if sizes:
            return min(sizes, key=lambda label: sizes[label])
        return self._labels.use("other") or self._question.groups[0]


class ClusterNames:
    """Names of given clusters."""

    def __init__(self, question: Question, repairs: Repairs) -> None:
        self._question = question
        self._repairs = repairs
        self._matcher = Matcher(question.items)
        self._labels = _Labels(question, repairs)
        self._name_of: dict[tuple[str, ...], str] = {}

    def open_items(self) -> list[str]:
        nameless = {item for cluster in self._open_clusters() for item in cluster}
        return [item for item in self._question.items if item in nameless]

    def open_question(self) -> Question:
        return replace(
            self._question,
            items=tuple(self.open_items()),
            clusters=tuple(self._open_clusters()),
            groups=tuple(g for g in self._question.groups if g not in self._name_of.values()),
        )

    def add(self, answer: Grouping) -> str:
        """Name each cluster by the group with most of its items; each name is used once."""
        for (cluster, label), _ in self._votes(answer).most_common():
            if cluster not in self._name_of and label not in self._name_of.values():
                self._name_of[cluster] = label
        taken = json.dumps(list(self._name_of.values()), ensure_ascii=False)
        return f"These groups have no name of their own yet. Names that are taken: {taken}."

    def complete(self, fallback: Grouper) -> None:
        """Use the names of the fallback, with numbers if they are repeated or missing."""
        answer = fallback.group(self.open_question())
        remaining = self._open_clusters()
        self.add(answer)
        preferred = dict(reversed([pair for pair, _ in self._votes(answer).most_common()]))
        for cluster in self._open_clusters():
            taken = [*self._question.items, *self._name_of.values()]
            self._name_of[cluster] = distinct(preferred.get(cluster, "kind"), taken)
        self._repairs.by_fallback += [self._name_of[cluster] for cluster in remaining]

    def result(self) -> Grouping:
        return {self._name_of[cluster]: cluster for cluster in self._question.clusters}

    def _votes(self, answer: Grouping) -> Counter[tuple[tuple[str, ...], str]]:
        """Return the number of items of each unnamed cluster in each group of the answer."""
        cluster_of = {item: cluster for cluster in self._open_clusters() for item in cluster}
        votes: Counter[tuple[tuple[str, ...], str]] = Counter()
        for written_label, written_items in answer.items():
            label = self._labels.use(written_label)
            for written in written_items:
                item = self._matcher.find(written)
                if item is None:
                    self._repairs.invented.append(written)
                elif item in cluster_of and label is not None:
                    votes[cluster_of[item], label] += 1
        return votes

    def _open_clusters(self) -> list[tuple[str, ...]]:
        return [c for c in self._question.clusters if c not in self._name_of]


class _Labels:
    """Maps the names of groups in answers to valid, distinct names."""

    def __init__(self, question: Question, repairs: Repairs) -> None:
        self._given = Matcher(question.groups) if question.groups else None
        self._reserved = {fold(name) for name in (*question.items, VOID_NAME)}
        self._repairs = repairs
        self._used: dict[str, str] = {}

    def use(self, written: str) -> str | None:
        """Return the name to use for a group, consistent over answers; None if it is rejected."""
        if self._given:
            label = self._given.find(written)
        else:
            label = self._invented(clean_label(written))
        if label != written:
            outcome = "refused" if label is None else label
            self._repairs.labels.append(f"{written} -> {outcome}")
        return label

    def _invented(self, label: str) -> str | None:
        key = fold(label)
        if not key:
            return None
        if key not in self._used:
            candidate = f"{label} group" if key in self._reserved else label
            used = distinct(candidate, [*self._reserved, *self._used.values()])
            # The next answer refers to the group by this name.
            self._used |= {key: used, fold(used): used}
        return self._used[key]
