"""DUSt3R and MASt3R: point maps of image pairs, aligned to depth maps of a set.

Written for the interface that github.com/naver/dust3r and github.com/naver/mast3r publish; it has
never run with their code or weights. Both are licensed for non-commercial use only.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from toolkit.base.frame import Frame
from toolkit.depth.depth_priors.options import PriorModelOptions
from toolkit.depth.depth_priors.provider import (
    Confidence,
    DepthKind,
    DepthPrior,
    PixelMapping,
    PriorModel,
    PriorSet,
    ScaleScope,
)
from toolkit.depth.depth_priors.providers.packages import (
    image_of,
    import_package,
    resized,
    sha256_of,
    weights_of,
)
from toolkit.semantics.features.pretrained.loading import device_of

_LICENCE = "CC BY-NC-SA 4.0 (non-commercial)"
_CLASSES = {
    "dust3r": ("dust3r.model", "AsymmetricCroCo3DStereo"),
    "mast3r": ("mast3r.model", "AsymmetricMASt3R"),
}
_LONG_SIDE, _PATCH = 512, 16
_ITERATIONS, _RATE = 300, 0.01


class PairwiseDepth:
    """Depth of a set by DUSt3R or MASt3R with their global alignment. Poses are those of the set.

    Args:
        options: `path` is the checkpoint, or a folder in the format of huggingface_hub. `code` is
            the repository, since the packages cannot be installed by pip.
        kind: "dust3r" or "mast3r".

    Raises:
        DependencyError: the package cannot be imported.
        FormatError: the weights do not exist.
    """

    joint = True

    def __init__(self, options: PriorModelOptions, kind: str) -> None:
        path = weights_of(options)
        source = f"https://github.com/naver/{kind}"
        if kind == "mast3r":
            # Adds the DUSt3R inside the repository to the import path.
            import_package("mast3r.utils.path_to_dust3r", options, source)
        module, name = _CLASSES[kind]
        network = getattr(import_package(module, options, source), name)
        self._pairs = import_package("dust3r.image_pairs", options, source)
        self._inference = import_package("dust3r.inference", options, source)
        self._alignment = import_package("dust3r.cloud_opt", options, source)
        self._device = device_of("auto")
        self._network = network.from_pretrained(str(path)).to(self._device).eval()
        self._min_confidence = options.min_confidence
        self.model = PriorModel(f"{kind} {path.name}", sha256_of(path), _LICENCE)

    def predict(self, frames: Sequence[Frame]) -> PriorSet:
        """Depth of the frames of a set, up to one scale."""
        images = [_image(frame, number) for number, frame in enumerate(frames)]
        if len(images) == 1:
            # A pair of the same image, as in the demonstration of the package.
            images.append(_image(frames[0], 1))
        pairs = self._pairs.make_pairs(
            images, scene_graph="complete", prefilter=None, symmetrize=True
        )
        output = self._inference.inference(
            pairs, self._network, self._device, batch_size=1, verbose=False
        )
        scene = self._aligned(output, len(images))
        depths, confidences = scene.get_depthmaps(), list(scene.im_conf)
        poses = _numpy(scene.get_im_poses()).astype(np.float64)[: len(frames)]
        priors = tuple(
            self._prior(frame, _numpy(depth), _numpy(confidence))
            for frame, depth, confidence in zip(frames, depths, confidences, strict=False)
        )
        return PriorSet(
            tuple(frame.index for frame in frames), priors, np.linalg.inv(poses[0]) @ poses
        )

    def _aligned(self, output: Any, count: int) -> Any:
        modes = self._alignment.GlobalAlignerMode
        mode = modes.PointCloudOptimizer if count > 2 else modes.PairViewer
        scene = self._alignment.global_aligner(output, device=self._device, mode=mode)
        if count > 2:
            with torch.enable_grad():
                scene.compute_global_alignment(
                    init="mst", niter=_ITERATIONS, schedule="cosine", lr=_RATE
                )
        return scene

    def _prior(self, frame: Frame, depth: np.ndarray, confidence: np.ndarray) -> DepthPrior:
        return DepthPrior(
            np.ascontiguousarray(depth, np.float32),
            DepthKind.SCALED,
            ScaleScope.SET,
            self.model,
            _mapping(frame),
            # 1 + exp(x) of the network, without an upper limit; the package uses a minimum of 3.
            Confidence(np.ascontiguousarray(confidence, np.float32), self._min_confidence),
        )


def _sizes(frame: Frame) -> tuple[tuple[int, int], tuple[int, int]]:
    """Size of the resized image, and of the crop of whole patches at its centre."""
    width, height = frame.camera.size
    scale = _LONG_SIDE / max(width, height)
    whole = round(width * scale), round(height * scale)
    return whole, (whole[0] // _PATCH * _PATCH, whole[1] // _PATCH * _PATCH)


def _mapping(frame: Frame) -> PixelMapping:
    whole, crop = _sizes(frame)
    left, top = (-((w - c) // 2) for w, c in zip(whole, crop, strict=True))
    resize = PixelMapping.resize(frame.camera.size, whole)
    return resize.then(PixelMapping((1.0, 1.0), (float(left), float(top))))


def _image(frame: Frame, number: int) -> dict[str, Any]:
    """An image as the package's `load_images` returns it: [1, 3, h, w] in [-1, 1]."""
    whole, crop = _sizes(frame)
    left, top = ((w - c) // 2 for w, c in zip(whole, crop, strict=True))
    image = resized(image_of(frame), whole)[top : top + crop[1], left : left + crop[0]]
    tensor = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))).float() / 127.5 - 1.0
    return {
        "img": tensor[None],
        "true_shape": np.array([[crop[1], crop[0]]], np.int32),
        "idx": number,
        "instance": str(number),
    }


def _numpy(values: Any) -> np.ndarray:
    return np.asarray(values.detach().cpu().numpy() if hasattr(values, "detach") else values)
