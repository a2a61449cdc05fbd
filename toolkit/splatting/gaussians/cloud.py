"""Sets of Gaussians, used for maps and parts of maps: spheres (H-18) or ellipsoids."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.splatting.gaussians.ellipsoids import SHAPES, Ellipsoids, rotation_matrices

# The tensors of a cloud, one row for each Gaussian.
PARAMETERS = ("means", "log_radii", "opacity_logits", "colours", "features")


@dataclass(frozen=True)
class LowPass:
    """Convolution of projected Gaussians with a Gaussian, so that none is smaller than a pixel.

    Attributes:
        variance_px2: its variance in squared pixels; 0 for none.
        compensated: reduce opacities such that the integral over the image is kept, as
            Mip-Splatting does; otherwise the Gaussians become larger, as with 3DGS.
    """

    variance_px2: float = 0.0
    compensated: bool = False


NO_LOW_PASS = LowPass()
# Of maps that were trained with 3DGS; its viewers do the same.
LOW_PASS_3DGS = LowPass(0.3)
# Of our own ellipsoids: they look the same at all image sizes.
PIXEL_FILTER = LowPass(0.1, compensated=True)


@dataclass(frozen=True)
class GaussianCloud:
    """N Gaussians with S semantic channels.

    Unless `ellipsoids` is set, the Gaussians are isotropic and their colour does not depend on the
    view, as tracking and mapping need them.

    Radius and opacity are stored as logarithm and logit, so that any real value is valid and
    optimisation is unconstrained.

    Attributes:
        means: [N, 3] float32, centres in the map's frame, metres.
        log_radii: [N] float32, natural logarithm of the standard deviation in metres; the mean of
            the axes' logarithms for ellipsoids, which are rendered with their own scales.
        opacity_logits: [N] float32.
        colours: [N, 3] float32, RGB in [0, 1] (clamped only for display and export).
        features: [N, S] float32, S >= 0.
        centred_colours: how the colours were fitted. True: at the centres of the Gaussians, for
            dense tracking. False: at the pixels that show them, for rendering. See
            `rendering/texture.py`.
        ellipsoids: axes and view-dependent colours, or None. Their colours are clamped at 0.
        low_pass: how the projected Gaussians are filtered.

    Raises:
        ValueError: shapes do not match.
    """

    means: Tensor
    log_radii: Tensor
    opacity_logits: Tensor
    colours: Tensor
    features: Tensor
    centred_colours: bool = field(default=False, kw_only=True)
    ellipsoids: Ellipsoids | None = field(default=None, kw_only=True)
    low_pass: LowPass = field(default=NO_LOW_PASS, kw_only=True)

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        expected = {
            "means": (n, 3),
            "log_radii": (n,),
            "opacity_logits": (n,),
            "colours": (n, 3),
            "features": (n, self.features.shape[-1]),
        }
        for name, shape in expected.items():
            actual = tuple(getattr(self, name).shape)
            if actual != shape:
                raise ValueError(f"{name} must have shape {list(shape)}, got {list(actual)}")
        if self.ellipsoids is not None and len(self.ellipsoids) != n:
            raise ValueError(f"ellipsoids must be {n}, got {len(self.ellipsoids)}")

    def __len__(self) -> int:
        return self.means.shape[0]

    def __str__(self) -> str:
        return f"{len(self)} Gaussians, {self.features.shape[1]} feature channels"

    @property
    def radii_m(self) -> Tensor:
        """Standard deviations [N] in metres."""
        return self.log_radii.exp()

    @property
    def opacities(self) -> Tensor:
        """Opacities [N] in (0, 1)."""
        return self.opacity_logits.sigmoid()

    @property
    def pixel_filter(self) -> bool:
        """Whether the Gaussians are filtered by `PIXEL_FILTER`."""
        return self.low_pass == PIXEL_FILTER

    @classmethod
    def empty(cls, feature_channels: int = 0, device: str | torch.device = "cpu") -> GaussianCloud:
        """Create a cloud without Gaussians."""
        none = torch.zeros(0, dtype=torch.float32, device=device)
        return cls.from_values(
            means=none.view(0, 3),
            radii_m=none,
            opacities=none,
            colours=none.view(0, 3),
            features=none.new_zeros(0, feature_channels),
        )

    @classmethod
    def from_values(
        cls,
        means: Tensor,
        radii_m: Tensor,
        opacities: Tensor,
        colours: Tensor,
        features: Tensor | None = None,
    ) -> GaussianCloud:
        """Create a cloud from radii in metres (> 0) and opacities in (0, 1)."""
        if features is None:
            features = means.new_zeros(means.shape[0], 0)
        return cls(means, radii_m.log(), torch.logit(opacities), colours, features)

    @classmethod
    def concatenate(cls, clouds: list[GaussianCloud]) -> GaussianCloud:
        """Concatenate several clouds in order; colours are centred if all of them are.

        With ellipsoids among them, all become ellipsoids. The first cloud of ellipsoids, or else of
        all, decides the low-pass: spheres are mapped without one.
        """
        tensors = {name: torch.cat([getattr(c, name) for c in clouds]) for name in PARAMETERS}
        ellipsoids, shaped = None, [cloud for cloud in clouds if cloud.ellipsoids is not None]
        if shaped:
            ellipsoids = Ellipsoids.concatenate([cloud.as_ellipsoids() for cloud in clouds])
        return cls(
            **tensors,
            centred_colours=all(cloud.centred_colours for cloud in clouds),
            ellipsoids=ellipsoids,
            low_pass=(shaped or clouds)[0].low_pass,
        )

    def as_ellipsoids(self) -> Ellipsoids:
        """Return the shapes of all Gaussians."""
        return self.ellipsoids or Ellipsoids.spheres(self.log_radii)

    def axes_m(self) -> NDArray[np.float64] | None:
        """Axes [N, 3, 3] of ellipsoids, in rows, as long as the standard deviations."""
        if self.ellipsoids is None:
            return None
        shapes = self.ellipsoids.mapped(lambda tensor: tensor.detach().cpu().double())
        axes = rotation_matrices(shapes.rotations).mT * shapes.log_scales.exp()[:, :, None]
        return np.asarray(axes.numpy())

    def radii_seen_m(self, direction: NDArray[np.float64]) -> NDArray[np.float64]:
        """Radii [N] of discs of the areas of the Gaussians seen along a unit vector [3].

        The mean of the axes of a flat ellipsoid is much smaller than the floor that it covers.
        """
        axes_m = self.axes_m()
        if axes_m is None:
            return np.asarray(self.radii_m.cpu().double().numpy())
        lengths_m = np.linalg.norm(axes_m, axis=2)
        cosines = axes_m @ direction / lengths_m
        # Along an axis, one sees the ellipse of the two others.
        areas = lengths_m.prod(axis=1, keepdims=True) / lengths_m
        return np.asarray(((cosines * areas) ** 2).sum(axis=1) ** 0.25)

    def tensors(self) -> dict[str, Tensor]:
        """Return all tensors by name, those of the ellipsoids among them."""
        shapes = {} if self.ellipsoids is None else self.ellipsoids.tensors()
        return {name: getattr(self, name) for name in PARAMETERS} | shapes

    def with_tensors(self, tensors: Mapping[str, Tensor]) -> GaussianCloud:
        """Return a cloud of other `tensors`; it has ellipsoids if they contain their names."""
        values: dict[str, Any] = {name: tensors[name] for name in PARAMETERS}
        shapes = [tensors[name] for name in SHAPES if name in tensors]
        return replace(self, **values, ellipsoids=Ellipsoids(*shapes) if shapes else None)

    def recoloured(self, function: Callable[[Tensor], Tensor]) -> GaussianCloud:
        """Return the cloud with an affine function of colours [..., 3] applied to its colours."""
        ellipsoids = self.ellipsoids
        if ellipsoids is not None:
            offset = function(torch.zeros_like(ellipsoids.harmonics))
            harmonics = function(ellipsoids.harmonics) - offset
            ellipsoids = replace(ellipsoids, harmonics=harmonics)
        return replace(self, colours=function(self.colours), ellipsoids=ellipsoids)

    def scaled(self, factor: float) -> GaussianCloud:
        """Return the cloud with all lengths multiplied by a factor > 0."""
        ellipsoids, added = self.ellipsoids, math.log(factor)
        if ellipsoids is not None:
            ellipsoids = replace(ellipsoids, log_scales=ellipsoids.log_scales + added)
        return replace(
            self,
            means=self.means * factor,
            log_radii=self.log_radii + added,
            ellipsoids=ellipsoids,
        )

    def select(self, index: Tensor) -> GaussianCloud:
        """Select Gaussians by a boolean mask [N] or integer indices [M]."""
        if index.dtype == torch.bool:
            index = index.nonzero().squeeze(1)
        return self.mapped(lambda tensor: tensor.index_select(0, index))

    def transformed(self, T_new_old: np.ndarray) -> GaussianCloud:
        """Return the cloud transformed by a rigid motion [4, 4]; sizes do not change."""
        R = torch.as_tensor(T_new_old[:3, :3], dtype=self.means.dtype, device=self.means.device)
        t = torch.as_tensor(T_new_old[:3, 3], dtype=self.means.dtype, device=self.means.device)
        ellipsoids = self.ellipsoids
        if ellipsoids is not None:
            ellipsoids = ellipsoids.rotated(T_new_old[:3, :3])
        return replace(self, means=self.means @ R.T + t, ellipsoids=ellipsoids)

    def to(self, device: str | torch.device) -> GaussianCloud:
        """Return the cloud on a device; the same object if it is already there."""
        if self.means.device == torch.device(device):
            return self
        return self.mapped(lambda tensor: tensor.to(device))

    def detached(self) -> GaussianCloud:
        """Return the cloud detached from the autograd graph."""
        return self.mapped(torch.Tensor.detach)

    def mapped(self, function: Callable[[Tensor], Tensor]) -> GaussianCloud:
        """Apply a function of rows to all tensors."""
        return self.with_tensors({n: function(tensor) for n, tensor in self.tensors().items()})
