"""Feature loss of the papers, on colour and on semantic images."""

from __future__ import annotations

import pytest
import torch

from toolkit.semantics.codes import ColourCode, SemanticCode, flat_code
from toolkit.semantics.features.builtin import BuiltinEncoder
from toolkit.semantics.features.sources import Source, ViewDescriber
from toolkit.semantics.options import SemanticLossWeights
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.slam.mapping.view_features import FeatureLoss, ViewFeatures
from toolkit.splatting.losses.semantic import SemanticLoss

NAMES = ["wall", "chair", "table"]
TREE = Taxonomy({"everything": NAMES}, classes=NAMES)
COLOURS = torch.tensor([[0.9, 0.9, 0.2], [0.8, 0.1, 0.1], [0.1, 0.4, 0.9]]).numpy()
CODES = {"one-hot": flat_code(TREE), "colour": ColourCode(TREE, COLOURS)}
HEIGHT, WIDTH = 60, 80


def picture(seed: int) -> torch.Tensor:
    """Smooth random images, in which neighbouring pixels are similar."""
    small = torch.rand(1, 3, 12, 16, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.interpolate(small, (HEIGHT, WIDTH), mode="bilinear")[0]


def view(colour: torch.Tensor, features: torch.Tensor | None = None) -> torch.Tensor:
    """Rendered images [5 + S, H, W] of an opaque map at 2 m."""
    depth, silhouette = torch.full((1, HEIGHT, WIDTH), 2.0), torch.ones(1, HEIGHT, WIDTH)
    return torch.cat([colour, depth, silhouette, *([] if features is None else [features])])


def loss_of(weight: float, source: Source = "rgb", code: SemanticCode | None = None) -> FeatureLoss:
    semantics = None
    if code is not None:
        semantics = SemanticMapping(SemanticLoss(code, SemanticLossWeights()))
    return FeatureLoss(ViewFeatures(ViewDescriber(BuiltinEncoder(), source), semantics), weight)


def labels() -> torch.Tensor:
    """A chair and a table before a wall."""
    ids = torch.ones(HEIGHT, WIDTH, dtype=torch.int32)
    ids[20:50, 10:30], ids[30:55, 45:70] = 2, 3
    return ids


def rendered_classes(code: SemanticCode, ids: torch.Tensor) -> torch.Tensor:
    """Feature channels [S, H, W] of a map with these classes."""
    values = code.start_values.index_select(0, ids.reshape(-1).long())
    return values.T.reshape(-1, *ids.shape).contiguous()


def test_loss_is_zero_for_identical_images():
    loss, by_view = loss_of(0.5).gradient(view(picture(0)), picture(0))
    assert loss == 0.0
    assert torch.count_nonzero(by_view) == 0


def test_loss_is_proportional_to_the_weight():
    one, by_one = loss_of(1.0).gradient(view(picture(0)), picture(1))
    half, by_half = loss_of(0.5).gradient(view(picture(0)), picture(1))
    assert one > 0.01
    assert half == pytest.approx(0.5 * one)
    assert torch.allclose(by_half, 0.5 * by_one)


@pytest.mark.parametrize(
    ("source", "kind"), [("rgb", None), ("semantic", "one-hot"), ("both", "colour")]
)
def test_derivative_agrees_with_finite_differences(source, kind):
    code, features = CODES.get(kind), None
    if code is not None:
        generator = torch.Generator().manual_seed(0)
        features = rendered_classes(code, labels())
        features = features + 0.1 * torch.rand(features.shape, generator=generator)
    term, drawn = loss_of(1.0, source, code), view(picture(0), features)
    observed = labels().roll(6, dims=1)
    _, by_view = term.gradient(drawn, picture(1), observed)
    step = 1e-3 * by_view / by_view.norm()
    ahead, _ = term.gradient(drawn + step, picture(1), observed)
    behind, _ = term.gradient(drawn - step, picture(1), observed)
    slope = float(by_view.norm()) / (HEIGHT * WIDTH)  # undo the factor
    assert (ahead - behind) / 2e-3 == pytest.approx(slope, rel=0.05)


@pytest.mark.parametrize("code", CODES.values(), ids=CODES)
def test_semantic_image_is_compared_rather_than_the_colour(code):
    """The features of the map are moved, its colours are not; void pixels are not compared."""
    term = loss_of(0.5, "semantic", code)
    drawn, other = view(picture(0), rendered_classes(code, labels())), labels().roll(6, dims=1)
    loss, by_view = term.gradient(drawn, picture(1), other)
    assert loss > 1e-3
    assert torch.count_nonzero(by_view[:3]) == 0
    assert torch.count_nonzero(by_view[5:]) > 0
    void = torch.where(other == labels(), other, 0)
    assert term.gradient(drawn, picture(1), void)[0] < 0.2 * loss
    assert term.gradient(drawn, picture(1), None)[0] == 0.0
