"""LPIPS with random weights: properties of a distance, a reference in torch.nn, weight files."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from toolkit.base.errors import FormatError
from toolkit.runs.evaluation.lpips import MIN_SIDE, Lpips

CHANNELS = (64, 192, 384, 256, 256)


def alexnet() -> nn.Sequential:
    """The convolutional part of AlexNet, laid out as torchvision does."""
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, stride=4, padding=2),
        nn.ReLU(),
        nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2),
        nn.ReLU(),
        nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1),
        nn.ReLU(),
    )


@pytest.fixture(scope="module")
def network() -> nn.Sequential:
    torch.manual_seed(0)
    return alexnet().requires_grad_(False)


@pytest.fixture(scope="module")
def backbone(network: nn.Sequential) -> dict[str, Tensor]:
    """As torchvision's file; the classifier is there but unused."""
    tensors = {f"features.{name}": tensor for name, tensor in network.state_dict().items()}
    return tensors | {"classifier.1.bias": torch.zeros(4)}


@pytest.fixture(scope="module")
def heads() -> dict[str, Tensor]:
    """As the lpips package's file of linear weights, which are not negative."""
    generator = torch.Generator().manual_seed(1)
    return {
        f"lin{level}.model.1.weight": torch.rand(1, count, 1, 1, generator=generator)
        for level, count in enumerate(CHANNELS)
    }


@pytest.fixture(scope="module")
def files(tmp_path_factory, backbone, heads) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("lpips")
    torch.save(backbone, folder / "alexnet.pth")
    torch.save(heads, folder / "alex.pth")
    return folder / "alexnet.pth", folder / "alex.pth"


@pytest.fixture(scope="module")
def lpips(files) -> Lpips:
    return Lpips.load(files)


def images(height: int = 40, width: int = 53) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(0)
    image = generator.random((height, width, 3)).astype(np.float32)
    noise = generator.normal(0.0, 0.1, image.shape).astype(np.float32)
    return image, (image + noise).clip(0.0, 1.0)


def reference(network: nn.Sequential, heads: dict[str, Tensor], a, b) -> float:
    """The formula of the paper, layer by layer."""
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    x, y = (
        torch.from_numpy(((2.0 * image - 1.0 - shift) / scale).transpose(2, 0, 1)[None]).float()
        for image in (a, b)
    )
    total, level = 0.0, 0
    for layer in network:
        x, y = layer(x), layer(y)
        if isinstance(layer, nn.ReLU):
            unit_x, unit_y = (nn.functional.normalize(f, dim=1, eps=1e-10) for f in (x, y))
            weight = heads[f"lin{level}.model.1.weight"].reshape(-1)
            distance = torch.einsum("c,nchw->nhw", weight, (unit_x - unit_y) ** 2)
            total += float(distance.mean())
            level += 1
    assert level == 5
    return total


def test_it_is_the_formula_of_the_paper(lpips, network, heads):
    a, b = images()
    assert lpips(a, b) == pytest.approx(reference(network, heads, a, b), rel=1e-4)


def test_it_is_a_distance(lpips):
    a, b = images()
    assert lpips(a, a) == 0.0
    assert lpips(a, b) == pytest.approx(lpips(b, a), rel=1e-6)
    assert 0.0 < lpips(a, 0.5 * (a + b)) < lpips(a, b)


def test_images_too_small_for_the_network_have_none(lpips):
    assert lpips(*images(MIN_SIDE, MIN_SIDE)) > 0.0
    assert lpips(*images(MIN_SIDE - 1, 64)) is None


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_one_file_may_hold_all_weights(lpips, backbone, heads, tmp_path, suffix):
    """Under the names of a whole `lpips.LPIPS`."""
    slices = {0: 1, 3: 2, 6: 3, 8: 4, 10: 5}
    combined = dict(heads)
    for name, tensor in backbone.items():
        if name.startswith("features"):
            _, index, kind = name.split(".")
            combined[f"net.slice{slices[int(index)]}.{index}.{kind}"] = tensor
    file = tmp_path / f"lpips{suffix}"
    save = torch.save if suffix == ".pth" else save_file
    save(combined, file)
    assert Lpips.load([file])(*images()) == lpips(*images())


def test_the_linear_weights_of_the_lpips_package_are_read(files):
    """torchmetrics ships the same file."""
    torchmetrics = importlib.util.find_spec("torchmetrics")
    if torchmetrics is None or torchmetrics.origin is None:
        pytest.skip("torchmetrics is not installed")
    heads = Path(torchmetrics.origin).parent / "functional/image/lpips_models/alex.pth"
    distance = Lpips.load([files[0], heads])(*images())
    assert distance is not None
    assert distance > 0.0


def test_missing_parameters_and_wrong_shapes_are_named(files, backbone, heads, tmp_path):
    with pytest.raises(FormatError, match=r"alexnet.pth: lin.0 is missing; give torchvision's"):
        Lpips.load(files[:1])
    with pytest.raises(FormatError, match=r"alex.pth: features.0.weight is missing"):
        Lpips.load(files[1:])
    # The heads of VGG have other widths.
    torch.save(heads | {"lin2.model.1.weight": torch.rand(1, 256, 1, 1)}, tmp_path / "vgg.pth")
    with pytest.raises(FormatError, match=r"lin.2 must have shape \[1, 384, 1, 1\], got \[1, 256"):
        Lpips.load([files[0], tmp_path / "vgg.pth"])


class Harmful:
    """Creates a file when unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_files_that_are_no_weights_are_refused_in_one_line(tmp_path):
    (tmp_path / "text.pth").write_text("not weights")
    (tmp_path / "text.safetensors").write_text("not weights")
    torch.save([1, 2], tmp_path / "list.pth")
    torch.save({"weight": Harmful(tmp_path / "touched")}, tmp_path / "harmful.pth")
    for name in ("text.pth", "text.safetensors", "list.pth", "harmful.pth", "nowhere.pth"):
        with pytest.raises(FormatError, match=name) as error:
            Lpips.load([tmp_path / name])
        assert len(str(error.value).splitlines()) == 1
    assert not (tmp_path / "touched").exists()
