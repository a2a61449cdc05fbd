"""The renderer on a GPU: correctness, times beside gsplat and the floors."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import torch

from benchmarks.gpu.report import UNTIMED, Plan, medians_ms, row, table
from benchmarks.gpu.scene import camera_of, surface_cloud, touched_pixels, with_ellipsoids
from toolkit.base.errors import DependencyError
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.native.constants import NEAR_M
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import backend
from toolkit.splatting.rendering.backend import Backend, ForwardPass
from toolkit.splatting.rendering.gsplat import GsplatBackend, load_gsplat
from toolkit.splatting.rendering.reference import ReferenceBackend


@functools.cache
def gsplat() -> Any:
    """The package, or None where it cannot run; it compiles itself when it is used first."""
    try:
        return load_gsplat()
    except DependencyError as error:
        print(f"Without gsplat: {error}.")
        return None


# Correctness


def check(plan: Plan) -> bool:
    """Largest error of each contestant against float64; whether ours is within its bounds."""
    contestants: dict[str, Backend] = {"ours": backend("cuda")}
    if gsplat() is not None:
        contestants["gsplat"] = GsplatBackend(gsplat())
    columns = ("channels", "shape", "backend", "images", "gradients", "pose gradient", "bound", "")
    table("Errors against float64", *columns)
    passed = True
    for channels in plan.channels:
        camera = camera_of(64, 40) if plan.timed else camera_of(20, 16)
        count = 4000 if plan.timed else 120
        spheres = surface_cloud(camera, count, channels - 4, seed=channels)
        generator = torch.Generator().manual_seed(channels)
        weights = torch.randn(channels + 1, camera.height, camera.width, generator=generator)
        # Eleven bits a factor in tf32, and alphas at the cut that fall either way.
        bound = 1e-2 if plan.timed else 2e-3
        for shape, cloud in (("spheres", spheres), ("ellipsoids", with_ellipsoids(spheres))):
            exact = cloud.mapped(torch.Tensor.double)
            expected = _drawn(ReferenceBackend(), exact, camera, weights.double())
            for name, contestant in contestants.items():
                actual = _drawn(contestant, cloud.to(plan.device), camera, weights.to(plan.device))
                errors = [error_of(a, b) for a, b in zip(actual, expected, strict=True)]
                # Written so that NaN does not pass: the memory was full of it.
                good = name != "ours" or all(error <= bound for error in errors)
                passed &= good
                verdict = "" if name != "ours" else "ok" if good else "WRONG"
                row(channels, shape, name, *errors, bound, verdict)
    return passed


def _drawn(
    contestant: Backend, cloud: GaussianCloud, camera: Camera, weights: torch.Tensor
) -> tuple[torch.Tensor, ...]:
    """Images, all gradients in one row, and the pose's, in float64 on the CPU."""
    pose = se3.exp(np.array([0.01, -0.02, 0.015, 0.01, -0.02, 0.01]))
    drawn = contestant.forward(cloud, camera, pose, cloud.features, None)
    found = drawn.backward(weights)
    gradients = torch.cat([g[:, None].flatten(1) for g in found.by_name().values()], dim=1)
    dense = torch.zeros(len(cloud), gradients.shape[1], dtype=torch.float64)
    dense[found.ids.cpu()] = gradients.double().cpu()
    return drawn.images.double().cpu(), dense, found.T_camera_map.cpu()


def error_of(actual: torch.Tensor, expected: torch.Tensor) -> float:
    """Root of the mean square error, relative to the truth's."""
    return float((actual - expected).norm() / expected.norm())


# Speed


class Contest(Protocol):
    """One contestant on one scene."""

    def forward(self) -> object:
        """Draw."""
        ...

    def backward(self) -> object:
        """Gradients of the view drawn last."""
        ...


class OurContest:
    """A backend of ours, from parameters to their gradients."""

    def __init__(self, renderer: Backend, cloud: GaussianCloud, camera: Camera) -> None:
        self._backend, self._cloud, self._camera = renderer, cloud, camera
        self._drawn: ForwardPass | None = None
        self._weights = _weights(5 + cloud.features.shape[1], camera, cloud.means.device)

    def forward(self) -> None:
        """Draw."""
        cloud = self._cloud
        self._drawn = None
        self._drawn = self._backend.forward(cloud, self._camera, np.eye(4), cloud.features, None)

    def backward(self) -> object:
        """Gradients of everything, and the pose's."""
        assert self._drawn is not None
        return self._drawn.backward(self._weights)


class GsplatContest:
    """gsplat by itself: what it takes lies ready, what it gives is left as it is."""

    def __init__(self, package: Any, cloud: GaussianCloud, camera: Camera) -> None:
        self._package, self._size = package, (camera.width, camera.height)
        device = cloud.means.device
        values = (
            cloud.means,
            cloud.radii_m[:, None].expand(-1, 3),
            cloud.opacities,
            torch.cat([cloud.colours, cloud.features], 1),
            torch.eye(4, device=device)[None],
        )
        self._leaves = [v.detach().clone().contiguous().requires_grad_() for v in values]
        self._upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=device).repeat(len(cloud), 1)
        self._K = torch.from_numpy(camera.matrix).float().to(device)[None]
        self._K[:, :2, 2] += 0.5
        weights = _weights(5 + cloud.features.shape[1], camera, device).permute(1, 2, 0)[None]
        self._weights = [weights[..., 1:].contiguous(), weights[..., :1].contiguous()]
        self._drawn: tuple[torch.Tensor, torch.Tensor] | None = None

    def forward(self) -> None:
        """Draw."""
        means, scales, opacities, colours, viewmat = self._leaves
        self._drawn = None
        images, alphas, _ = self._package.rasterization(
            means=means,
            quats=self._upright,
            scales=scales,
            opacities=opacities,
            colors=colours,
            viewmats=viewmat,
            Ks=self._K,
            width=self._size[0],
            height=self._size[1],
            near_plane=NEAR_M,
            eps2d=0.0,
            render_mode="RGB+D",
        )
        self._drawn = images, alphas

    def backward(self) -> object:
        """Gradients of everything, and the pose's."""
        assert self._drawn is not None
        return torch.autograd.grad(self._drawn, self._leaves, self._weights)


def _weights(channels: int, camera: Camera, device: torch.device) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    shape = (channels, camera.height, camera.width)
    return torch.randn(shape, generator=generator).to(device)


def _ceilings(plan: Plan) -> tuple[float, float]:
    """Bytes a second of a large copy, read and written, and float32 operations a second."""
    if not plan.timed:
        return float("nan"), float("nan")
    source = torch.randn(2**28, device="cuda")
    target = torch.empty_like(source)
    a, b = (torch.randn(8192, 8192, device="cuda") for _ in range(2))
    torch.backends.cuda.matmul.allow_tf32 = False
    steps = {"copy": lambda: target.copy_(source), "product": lambda: a @ b}
    ms = medians_ms(steps, plan.repeats)
    return 2 * 4 * source.numel() / ms["copy"] * 1e3, 2 * 8192**3 / ms["product"] * 1e3


def _floors_ms(
    cloud: GaussianCloud, camera: Camera, rates: tuple[float, float]
) -> tuple[float, float]:
    """Forward and backward: the larger of the bytes' and the operations' time."""
    bandwidth, peak = rates
    count, features = cloud.features.shape
    inputs, images = 4 * count * (8 + features), 4 * camera.width * camera.height * (5 + features)
    alphas, channels = touched_pixels(cloud, camera), 4 + features
    # An alpha takes about 12 operations, a channel of its weight two forward and four backward.
    forward = max((inputs + images) / bandwidth, alphas * (12 + 2 * channels) / peak)
    backward = max((2 * inputs + images) / bandwidth, alphas * (24 + 4 * channels) / peak)
    return 1e3 * forward, 1e3 * backward


def _steps(contest: Contest) -> dict[str, Callable[[], object]]:
    return {"forward": contest.forward, "backward": contest.backward}


def render_table(plan: Plan) -> None:
    """Forward and backward of ours and gsplat at every size, and the floors."""
    rates, rival = _ceilings(plan), gsplat()
    if plan.timed:
        print(f"\nCopy {rates[0] / 1e12:.2f} TB/s, float32 product {rates[1] / 1e12:.1f} TFLOP/s.")
    everyone = ["ours"] if rival is None else ["ours", "gsplat"]
    names = [f"{name} {way}" for way in ("forward", "backward") for name in everyone]
    floors = ("floor forward", "floor backward")
    table("Milliseconds a view", "Gaussians", "image", "channels", *names, *floors)
    camera = camera_of(*plan.size)
    for count in plan.counts:
        for channels in plan.channels:
            cloud = surface_cloud(camera, count, channels - 4).to(plan.device)
            contests: dict[str, Contest] = {"ours": OurContest(backend("cuda"), cloud, camera)}
            if rival is not None:
                contests["gsplat"] = GsplatContest(rival, cloud, camera)
            steps = {f"{n} {way}": s for n, c in contests.items() for way, s in _steps(c).items()}
            size = f"{camera.width}x{camera.height}"
            if plan.timed:
                ms = medians_ms(steps, plan.repeats)
                floor = _floors_ms(cloud, camera, rates)
                row(count, size, channels, *[ms[name] for name in names], *floor)
            else:
                for step in steps.values():
                    step()
                row(count, size, channels, *[UNTIMED] * len(names), "-", "-")


def ellipsoids_table(plan: Plan) -> None:
    """Forward and backward of ours: discs, filtered and with harmonics, beside the spheres."""
    ways = [f"{shape} {way}" for shape in ("spheres", "ellipsoids") for way in ("fwd", "bwd")]
    table("Milliseconds a view of ellipsoids", "Gaussians", "channels", *ways)
    camera, channels = camera_of(*plan.size), plan.channels[0]
    for count in plan.counts:
        spheres = surface_cloud(camera, count, channels - 4)
        times: list[object] = []
        for cloud in (spheres, with_ellipsoids(spheres)):
            contest = OurContest(backend("cuda"), cloud.to(plan.device), camera)
            times += _times(_steps(contest), plan)
        row(count, channels, *times)


def _times(steps: dict[str, Callable[[], object]], plan: Plan) -> list[object]:
    if not plan.timed:
        for step in steps.values():
            step()
        return [UNTIMED] * len(steps)
    return list(medians_ms(steps, plan.repeats).values())
