"""Stand-ins for packages that PyPI lacks, with the signatures that their repositories publish.

Each network returns the depth of a slanted plane, as the camera of its input image sees it.
"""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from toolkit.base.geometry import se3

# Poses of the images of a set, in the unit of the depth.
POSES = np.array([se3.exp([0.1 * n, 0.0, 0.02 * n, 0.0, 0.05 * n, 0.0]) for n in range(1, 9)])
DEPTH_SCALE = 0.5


def plane(columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Depth at positions in the frame relative to its size, in [0, 1]."""
    return 2.0 / (1.0 + 0.3 * (columns - 0.5) + 0.5 * (rows - 0.5))


def seen(image: np.ndarray) -> np.ndarray:
    """Depth [h, w] of an image [h, w, 3] in [0, 1] whose red and green are columns and rows."""
    return plane(image[..., 0], image[..., 1]).astype(np.float32)


def install(patch: pytest.MonkeyPatch, **modules: dict[str, Any]) -> None:
    """Add modules by dotted name (with __ for dots), and their parent packages."""
    for key, content in modules.items():
        name = key.replace("__", ".")
        parts = name.split(".")
        for end in range(1, len(parts)):
            parent = ".".join(parts[:end])
            if parent not in sys.modules:
                patch.setitem(sys.modules, parent, ModuleType(parent))
        module = ModuleType(name)
        vars(module).update(content)
        patch.setitem(sys.modules, name, module)


class _Network:
    @classmethod
    def from_pretrained(cls, path: str):
        network = cls()
        network.path = path
        return network

    def to(self, device: Any):
        return self

    def eval(self):
        return self


def install_dust3r(patch: pytest.MonkeyPatch) -> None:
    class AsymmetricCroCo3DStereo(_Network):
        pass

    class Scene:
        """PointCloudOptimizer or PairViewer."""

        def __init__(self, images: dict[int, torch.Tensor], aligned: bool) -> None:
            self._images, self.aligned = images, aligned
            self.im_conf = [
                torch.full(i.shape[-2:], 3.0 + n) for n, i in enumerate(images.values())
            ]

        def compute_global_alignment(self, init=None, niter_PnP=10, **kw) -> float:
            assert (init, kw["niter"], kw["schedule"]) == ("mst", 300, "cosine")
            self.aligned = True
            return 0.0

        def get_depthmaps(self, raw=False) -> list[torch.Tensor]:
            assert self.aligned
            colours = [0.5 * i[0].permute(1, 2, 0).numpy() + 0.5 for i in self._images.values()]
            return [torch.from_numpy(DEPTH_SCALE * seen(c)).requires_grad_() for c in colours]

        def get_im_poses(self) -> torch.Tensor:
            return torch.from_numpy(POSES[: len(self._images)]).requires_grad_()

    def make_pairs(imgs, scene_graph="complete", prefilter=None, symmetrize=True):
        assert scene_graph == "complete"
        pairs = [(a, b) for n, a in enumerate(imgs) for b in imgs[:n]]
        return pairs + [(b, a) for a, b in pairs] if symmetrize else pairs

    def inference(pairs, model, device, batch_size=8, verbose=True):
        assert isinstance(model, AsymmetricCroCo3DStereo)
        for image, _ in pairs:
            assert image["img"].shape[0] == 1
            assert image["img"].abs().max() <= 1.0
            assert (image["true_shape"][0] == image["img"].shape[-2:]).all()
            assert all(size % 16 == 0 for size in image["img"].shape[-2:])
        return {"images": {i["idx"]: i["img"] for pair in pairs for i in pair}}

    modes = SimpleNamespace(PointCloudOptimizer="cloud", PairViewer="pair")

    def global_aligner(dust3r_output, device, mode=modes.PointCloudOptimizer, **optim_kw):
        images = dict(sorted(dust3r_output["images"].items()))
        assert mode == (modes.PairViewer if len(images) == 2 else modes.PointCloudOptimizer)
        return Scene(images, aligned=mode == modes.PairViewer)

    class AsymmetricMASt3R(AsymmetricCroCo3DStereo):
        pass

    install(
        patch,
        dust3r__model={"AsymmetricCroCo3DStereo": AsymmetricCroCo3DStereo},
        dust3r__image_pairs={"make_pairs": make_pairs},
        dust3r__inference={"inference": inference},
        dust3r__cloud_opt={"global_aligner": global_aligner, "GlobalAlignerMode": modes},
        mast3r__utils__path_to_dust3r={},
        mast3r__model={"AsymmetricMASt3R": AsymmetricMASt3R},
    )


def install_depth_anything_3(patch: pytest.MonkeyPatch, metric: int = 0) -> None:
    class DepthAnything3(_Network):
        def to(self, device: Any):
            assert isinstance(device, torch.device)
            return self

        def inference(self, image, extrinsics=None, intrinsics=None, process_res=504, **kw):
            assert all(i.dtype == np.uint8 and i.ndim == 3 for i in image)
            height, width = image[0].shape[:2]
            scale = process_res / max(width, height)
            size = tuple(round(scale * n / 14) * 14 for n in (width, height))
            at = np.meshgrid(*((np.arange(n) + 0.5) / n for n in size))
            depth = np.stack([DEPTH_SCALE * plane(*at).astype(np.float32) for _ in image])
            sky = np.zeros(depth.shape, np.float32)
            sky[:, 0] = 1.0
            count = len(image)
            matrix = np.array([[400.0, 0, size[0] / 2], [0, 400.0, size[1] / 2], [0, 0, 1]])
            return SimpleNamespace(
                depth=depth,
                is_metric=metric,
                sky=sky,
                conf=np.full(depth.shape, 2.0, np.float32),
                extrinsics=se3.inverse(POSES[:count])[:, :3],
                intrinsics=np.tile(matrix, (count, 1, 1)),
            )

    install(patch, depth_anything_3__api={"DepthAnything3": DepthAnything3})


def install_moge(patch: pytest.MonkeyPatch, metric: bool = True) -> None:
    class MoGeModel(_Network):
        def infer(
            self,
            image,
            num_tokens=None,
            resolution_level=9,
            force_projection=True,
            apply_mask=True,
            fov_x=None,
            use_fp16=True,
        ):
            assert image.shape[0] == 3
            self.fov_x = fov_x
            depth = torch.from_numpy(DEPTH_SCALE * seen(image.permute(1, 2, 0).numpy()))
            mask = torch.ones(depth.shape, dtype=torch.bool)
            mask[0] = False
            return {"depth": torch.where(mask, depth, torch.inf), "mask": mask}

    if metric:
        MoGeModel.scale_head = None
    install(patch, moge__model__v2={"MoGeModel": MoGeModel})


def install_vggt(patch: pytest.MonkeyPatch) -> None:
    class VGGT(_Network):
        def __call__(self, images: torch.Tensor, query_points=None) -> dict[str, torch.Tensor]:
            assert images.ndim == 4
            assert images.shape[-1] == 518
            assert images.shape[-2] % 14 == 0
            depth = np.stack([DEPTH_SCALE * seen(i.permute(1, 2, 0).numpy()) for i in images])
            return {
                "pose_enc": torch.zeros(1, len(images), 9),
                "depth": torch.from_numpy(depth)[None, ..., None],
                "depth_conf": torch.full((1, *depth.shape), 2.0),
            }

    def pose_encoding_to_extri_intri(pose_encoding, image_size_hw=None, **kw):
        count, (height, width) = pose_encoding.shape[1], image_size_hw
        matrix = torch.tensor([[400.0, 0, width / 2], [0, 400.0, height / 2], [0, 0, 1]])
        extrinsics = torch.from_numpy(se3.inverse(POSES[:count])[:, :3])
        return extrinsics[None], matrix.expand(1, count, 3, 3)

    install(
        patch,
        vggt__models__vggt={"VGGT": VGGT},
        vggt__utils__pose_enc={"pose_encoding_to_extri_intri": pose_encoding_to_extri_intri},
    )
