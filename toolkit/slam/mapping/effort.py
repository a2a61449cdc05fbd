"""Number of optimisation steps of a new keyframe, from the residual of its images.

A constant cannot be right for a camera that moves by millimetres and one that moves by decimetres:
the next frame is aligned to the map, which must fit what the keyframe added. The residual is that
of the newest keyframe, whose view contains the new surfaces and those of earlier keyframes.
"""

from __future__ import annotations

from dataclasses import dataclass, field

# A keyframe is explained when its loss has come down to this: 5 mm of depth and 1 % of intensity.
_EXPLAINED = 0.01
# The loss has stopped falling if it falls by less than this fraction between two measurements. In
# recordings at full rate, it falls by 2 to 8 % within the first three steps.
_FALLING = 0.06


@dataclass
class Effort:
    """Decides after each step on a new keyframe whether another one is needed.

    Attributes:
        minimum, maximum: number of steps.
        taken: number of steps so far.
        losses: of the newest keyframe at those steps that used it.
    """

    minimum: int
    maximum: int
    taken: int = 0
    losses: list[float] = field(default_factory=list)

    @property
    def measures(self) -> bool:
        """Whether the next step must use the newest keyframe, to measure its loss."""
        later = self.taken - self.minimum
        return self.taken in (0, self.minimum - 1) or (later >= 0 and later % 2 == 1)

    @property
    def wanted(self) -> bool:
        """Whether another step is needed."""
        if self.taken < self.minimum:
            return True
        if self.taken >= self.maximum or len(self.losses) < 2:
            return False
        before, last = self.losses[-2:]
        return last > _EXPLAINED and last < (1.0 - _FALLING) * before

    def took(self, loss: float | None) -> None:
        """Count a step.

        Args:
            loss: of the newest keyframe before the step; None if the step used another one.
        """
        self.taken += 1
        if loss is not None:
            self.losses.append(loss)
