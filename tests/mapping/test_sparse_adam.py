"""Sparse Adam: kernels against torch, torch against Adam, and a map that changes size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from toolkit.base.native import available_instruction_sets, load_variant
from toolkit.slam.mapping import sparse_adam
from toolkit.slam.mapping.sparse_adam import BETA1, BETA2, LearningRates, SparseAdam
from toolkit.slam.submaps.optimiser_state import OptimiserState
from toolkit.splatting.gaussians.cloud import PARAMETERS, GaussianCloud

PLAIN = ("log_radii", "opacity_logits", "colours", "features")  # parameters in their own unit


@pytest.fixture
def use(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Choose a compiled variant by name, or "torch"."""

    def choose(name: str) -> None:
        module = None if name == "torch" else load_variant(name)
        monkeypatch.setattr(sparse_adam, "kernels_for", lambda tensor: module)

    return choose


@pytest.fixture(params=[*available_instruction_sets(), "torch"])
def any_way(request: pytest.FixtureRequest, use: Callable[[str], None]) -> None:
    use(request.param)


def cloud_of(count: int, channels: int = 2) -> GaussianCloud:
    generator = torch.Generator().manual_seed(0)
    return GaussianCloud.from_values(
        torch.randn(count, 3, generator=generator),
        0.01 + 0.1 * torch.rand(count, generator=generator),
        0.1 + 0.8 * torch.rand(count, generator=generator),
        torch.rand(count, 3, generator=generator),
        torch.randn(count, channels, generator=generator),
    )


def gradients_for(cloud: GaussianCloud, ids: Tensor, seed: int) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return {
        f: torch.randn(len(ids), *getattr(cloud, f).shape[1:], generator=generator)
        for f in PARAMETERS
    }


def ids_of(count: int, seed: int) -> Tensor:
    """About half of the Gaussians, ascending."""
    return (torch.rand(count, generator=torch.Generator().manual_seed(seed)) < 0.5).nonzero()[:, 0]


def runs_of(count: int, seed: int) -> Tensor:
    """Runs of consecutive Gaussians, ascending, as in a view."""
    return torch.cat([torch.arange(seed, count // 8), torch.arange(count // 2 + seed, count)])


class OptimisedCloud:
    """The optimiser of a cloud, and its state."""

    def __init__(self, count: int, rates: LearningRates | None = None) -> None:
        self.state = OptimiserState(torch.zeros(count, dtype=torch.int32))
        self._adam = SparseAdam(rates or LearningRates())

    def step(self, cloud: GaussianCloud, *arguments: Any) -> None:
        self._adam.step(self.state, cloud, *arguments)


def run(
    steps: int = 6, count: int = 103, choose: Callable[[int, int], Tensor] = ids_of
) -> tuple[GaussianCloud, OptimisedCloud]:
    cloud = cloud_of(count)
    optimiser = OptimisedCloud(count)
    for seed in range(steps):
        ids = choose(count, seed)
        optimiser.step(cloud, gradients_for(cloud, ids, seed), ids)
    return cloud, optimiser


@pytest.mark.parametrize(("count", "choose"), [(103, ids_of), (1100, runs_of)])
@pytest.mark.parametrize("name", available_instruction_sets())
def test_kernels_agree_with_torch(use, name, count, choose):
    use("torch")
    expected, slow = run(count=count, choose=choose)
    use(name)
    actual, fast = run(count=count, choose=choose)
    for field in PARAMETERS:
        assert torch.allclose(
            getattr(actual, field), getattr(expected, field), rtol=1e-4, atol=1e-5
        ), field
    expected_state = slow.state.state()
    for name, array in fast.state.state().items():
        assert np.allclose(array, expected_state[name], rtol=1e-4, atol=1e-6), name


@pytest.mark.parametrize("parameter", PLAIN)
def test_touching_all_is_plain_adam(any_way, parameter):
    rates = replace(LearningRates(), settle_steps=0.0)
    cloud = cloud_of(31)
    leaf = getattr(cloud, parameter).clone().requires_grad_()
    plain = torch.optim.Adam(
        [leaf], lr=getattr(rates, parameter), betas=(BETA1, BETA2), eps=rates.epsilon
    )
    optimiser = OptimisedCloud(31, rates)
    ids = torch.arange(31)
    for seed in range(8):
        gradient = gradients_for(cloud, ids, seed)[parameter]
        leaf.grad = gradient
        plain.step()
        optimiser.step(cloud, {parameter: gradient}, ids)
    assert torch.allclose(getattr(cloud, parameter), leaf.detach(), rtol=1e-4, atol=1e-5)


def test_centres_move_in_units_of_their_radius(any_way):
    """The same scene twice as large moves twice as far, against gradients half as steep."""
    moved = []
    for scale in (1.0, 2.0):
        cloud = cloud_of(20)
        cloud = replace(cloud, means=cloud.means * scale, log_radii=(cloud.radii_m * scale).log())
        before = cloud.means.clone()
        optimiser = OptimisedCloud(20)
        ids = torch.arange(20)
        for seed in range(3):
            gradient = gradients_for(cloud, ids, seed)["means"] / scale
            optimiser.step(cloud, {"means": gradient}, ids)
        moved.append((cloud.means - before) / scale)
    assert torch.allclose(moved[0], moved[1], rtol=1e-3, atol=1e-6)
    assert float(moved[0].abs().max()) > 1e-3


def test_steps_go_against_the_gradient(any_way):
    cloud, ids = cloud_of(40), torch.arange(40)
    before = {f: getattr(cloud, f).clone() for f in PARAMETERS}
    optimiser = OptimisedCloud(40)
    gradients = gradients_for(cloud, ids, 0)
    optimiser.step(cloud, gradients, ids)
    for name, gradient in gradients.items():
        assert bool(((getattr(cloud, name) - before[name]) * gradient <= 0).all()), name
        assert not torch.equal(getattr(cloud, name), before[name])


def test_only_the_named_rows_and_parameters_move(any_way):
    cloud = cloud_of(50)
    before = {f: getattr(cloud, f).clone() for f in PARAMETERS}
    optimiser = OptimisedCloud(50)
    ids = torch.tensor([0, 3, 49])
    gradients = gradients_for(cloud, ids, 0)
    del gradients["features"]
    optimiser.step(cloud, gradients, ids)
    still = torch.ones(50, dtype=torch.bool)
    still[ids] = False
    for name, values in before.items():
        assert torch.equal(getattr(cloud, name)[still], values[still]), name
    assert torch.equal(cloud.features, before["features"])
    assert optimiser.state.steps.tolist() == [int(i in (0, 3, 49)) for i in range(50)]


def test_rates_fall_as_a_gaussian_settles(any_way):
    rates = replace(LearningRates(), settle_steps=5.0)
    cloud = cloud_of(1)
    optimiser = OptimisedCloud(1, rates)
    strides = []
    for _ in range(21):
        before = cloud.colours.clone()
        optimiser.step(cloud, {"colours": torch.full((1, 3), 100.0)}, torch.tensor([0]))
        strides.append(float((before - cloud.colours)[0, 0]))
    # Under a constant gradient each stride is rate / (1 + steps / settle_steps).
    assert strides[0] == pytest.approx(rates.colours / (1 + 1 / 5), rel=0.02)
    assert strides[20] == pytest.approx(rates.colours / (1 + 21 / 5), rel=0.02)


def test_the_rate_factor_scales_the_stride_of_every_parameter(any_way):
    strides = []
    for factor in (1.0, 3.0):
        cloud, ids = cloud_of(20), torch.arange(20)
        before = {f: getattr(cloud, f).clone() for f in PARAMETERS}
        optimiser = OptimisedCloud(20)
        optimiser.step(cloud, gradients_for(cloud, ids, 0), ids, factor)
        strides.append({f: getattr(cloud, f) - before[f] for f in PARAMETERS})
    for name in PARAMETERS:
        assert torch.allclose(3.0 * strides[0][name], strides[1][name], rtol=1e-3, atol=1e-5), name


def test_nothing_seen_is_no_error(any_way):
    cloud, none = cloud_of(5), torch.zeros(0, dtype=torch.int64)
    optimiser = OptimisedCloud(5)
    optimiser.step(cloud, gradients_for(cloud, none, 0), none)
    assert not optimiser.state.steps.any()


def test_new_gaussians_start_without_a_past(any_way):
    _, optimiser = run(count=20)
    before = optimiser.state.state()
    optimiser.state.extend(7)
    after = optimiser.state.state()
    assert after["first_means"].shape == after["second_means"].shape == (27, 3)
    for name, array in after.items():
        assert np.array_equal(array[:20], before[name]), name
        assert not array[20:].any(), name


def test_kept_gaussians_keep_their_past(any_way):
    _, optimiser = run(count=20)
    mask = torch.arange(20) % 3 != 0
    expected = {name: array[mask.numpy()] for name, array in optimiser.state.state().items()}
    optimiser.state.keep(mask.nonzero().squeeze(1))
    kept = optimiser.state.state()
    assert kept.keys() == expected.keys()
    for name, array in kept.items():
        assert np.array_equal(array, expected[name]), name


def test_a_restored_optimiser_goes_on_with_the_same_bits(any_way):
    cloud, optimiser = run()
    twin = GaussianCloud(*(getattr(cloud, f).clone() for f in PARAMETERS))
    other = OptimisedCloud(0)
    other.state = OptimiserState.from_state(optimiser.state.state())
    ids = ids_of(len(cloud), 99)
    for chosen, its in ((cloud, optimiser), (twin, other)):
        its.step(chosen, gradients_for(chosen, ids, 99), ids)
    assert all(torch.equal(getattr(cloud, f), getattr(twin, f)) for f in PARAMETERS)


def test_moments_exist_from_the_first_step_until_they_are_released(any_way):
    state = OptimiserState(torch.zeros(20, dtype=torch.int32))
    state.reset("means")
    assert state.state().keys() == {"steps"}
    _, optimiser = run(count=20)
    assert "second_colours" in optimiser.state.state()
    optimiser.state.release()
    assert optimiser.state.state().keys() == {"steps"} and optimiser.state.steps.any()
