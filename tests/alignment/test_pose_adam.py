"""Adam on poses, compared with that of torch."""

from __future__ import annotations

import numpy as np
import torch

from toolkit.splatting.alignment.pose_adam import MOMENTS, PoseAdam


def test_steps_are_those_of_torch():
    parameter = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    theirs = torch.optim.Adam([parameter], lr=0.01, betas=(0.9, 0.999), eps=1e-15)
    moments = np.zeros(MOMENTS)
    for gradient in np.random.default_rng(0).normal(0.0, [1, 2, 3, 4, 5, 6], (12, 6)):
        before = parameter.detach().clone()
        parameter.grad = torch.from_numpy(gradient)
        theirs.step()
        # Continued from its moments, each time by another object.
        step = PoseAdam(0.01, 0.02, moments).step(gradient)
        expected = (parameter.detach() - before).numpy()
        np.testing.assert_allclose(step[:3], expected[:3], rtol=1e-9)
        np.testing.assert_allclose(step[3:], 2.0 * expected[3:], rtol=1e-9)
