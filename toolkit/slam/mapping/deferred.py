"""Optimisation steps that wait for idle time, in real-time operation."""

from __future__ import annotations

from dataclasses import dataclass, field

from toolkit.base.keyframe import Keyframe


@dataclass
class StepCounts:
    """Numbers of optimisation steps.

    Attributes:
        due: steps that the options ask for.
        taken: steps that were taken.
        late: those of them that were taken after the next keyframe had been added.
    """

    due: int = 0
    taken: int = 0
    late: int = 0


@dataclass(eq=False)
class DueSteps:
    """Steps that are due for one keyframe.

    Attributes:
        keyframe: the keyframe.
        total: number of steps that the options ask for.
        taken: number of steps that were taken.
        window: keyframes that are optimised together with it; empty until the first step.
    """

    keyframe: Keyframe
    total: int
    taken: int = 0
    window: list[Keyframe] = field(default_factory=list)


class DeferredSteps:
    """The steps due for the keyframes of the active submap.

    Attributes:
        counts: totals over all submaps; steps that are due and never taken were skipped.
    """

    def __init__(self) -> None:
        self.counts = StepCounts()
        self._due: list[DueSteps] = []
        self._newest: Keyframe | None = None

    def __bool__(self) -> bool:
        """Whether any steps are due."""
        return bool(self._due)

    def add(self, keyframe: Keyframe, steps: int) -> None:
        """Add the steps of a new keyframe."""
        self.counts.due += steps
        self._newest = keyframe
        if steps:
            self._due.append(DueSteps(keyframe, steps))

    def skip(self, steps: int) -> None:
        """Count steps that are due but will not be taken."""
        self.counts.due += steps

    def next(self) -> DueSteps | None:
        """The steps of the newest keyframe with any: tracking needs the newest views first."""
        return self._due[-1] if self._due else None

    def take(self, due: DueSteps) -> None:
        """Count one step as taken."""
        due.taken += 1
        self.counts.taken += 1
        self.counts.late += due.keyframe is not self._newest
        if due.taken == due.total:
            self._due.remove(due)

    def clear(self) -> None:
        """Skip all steps that are due: the map was replaced."""
        self._due.clear()
