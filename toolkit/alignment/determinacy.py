"""What an alignment determines: the rise of its cost beside the pose, direction by direction.

The normal equations count every gradient of the model as a measurement, those of its noise and
blur, too: along a wall without texture they claim millimetres. The cost itself does not rise there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.alignment.backend import linearise
from toolkit.alignment.data import LevelProblem
from toolkit.geometry import se3

Array = NDArray[np.float64]

# The displacements at which the cost is measured: 5 cm or 2 degrees.
UNITS = np.array([0.05, 0.05, 0.05, 0.035, 0.035, 0.035])
# Relative rise of the cost at one unit from which a direction is determined well, so that stronger
# ones need not be measured.
_WELL = 0.3
# Relative rise that the errors of pixels and of the map hide.
_NOISE = 0.001


@dataclass(frozen=True, eq=False)
class Determinacy:
    """How well an alignment determines each direction.

    Attributes:
        directions: [6, 6] rows, displacements x in exp(x) T_model_frame of one unit, from the one
            that the alignment determines least.
        rises: [6] relative rise of the cost at each, the smaller one of both signs, at least 0;
            those of well determined directions follow from the normal equations.
    """

    directions: Array
    rises: Array

    def in_frame(self, T_model_frame: Array) -> Array:
        """Information [6, 6] of x in T_model_frame exp(x)."""
        duals = np.linalg.solve(self.directions.T, se3.adjoint(T_model_frame))
        return np.asarray((duals.T * (self.rises / _NOISE)) @ duals)


def determinacy(problem: LevelProblem) -> Determinacy:
    """Measure what an alignment determines.

    Args:
        problem: at its aligned pose.
    """
    here = linearise(_without_noise(problem))
    H = here.H[:6, :6]
    if not np.isfinite(here.cost) or not np.isfinite(H).all():
        return Determinacy(np.diag(UNITS), np.zeros(6))
    strengths, axes = np.linalg.eigh(H * np.outer(UNITS, UNITS))
    directions, rises = (UNITS[:, None] * axes).T, np.zeros(6)
    for k, direction in enumerate(directions):
        rises[k] = _rise(problem, here.cost, direction)
        if k > 0 and rises[k] > _WELL:
            rises[k + 1 :] = rises[k] * strengths[k + 1 :] / max(strengths[k], 1e-9)
            break
    return Determinacy(directions, rises)


def _without_noise(problem: LevelProblem) -> LevelProblem:
    """The problem with derivatives reduced by the noise.

    That of the pixels along stripes seems to determine the motion along them, so that the
    directions of the normal equations are not those that the cost knows least about.
    """
    texture = torch.nn.functional.softshrink(problem.model.texture, problem.scales.intensity)
    texture[..., ::3] = problem.model.texture[..., ::3]
    return replace(problem, model=replace(problem.model, texture=texture))


def _rise(problem: LevelProblem, cost: float, direction: Array) -> float:
    """Relative rise of the cost that a displacement [6] causes, of the sign that causes less.

    Alignment ends in a minimum of the noise if there is no other. Its cost rises beside it, too,
    but does not go on rising.
    """
    near = _least_rise(problem, cost, direction)
    if near > _WELL:
        return near
    return max(min(near, _least_rise(problem, cost, 2.0 * direction) - near), 0.0)


def _least_rise(problem: LevelProblem, cost: float, direction: Array) -> float:
    poses = (se3.exp(sign * direction) @ problem.T_model_frame for sign in (-1.0, 1.0))
    costs = [linearise(replace(problem, T_model_frame=T)).cost for T in poses]
    return min(costs) / max(cost, 1e-9) - 1.0
