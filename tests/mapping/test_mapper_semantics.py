"""A map that learns what its Gaussians are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from mapped_room import fed, same_bits
from mapped_submap import MappedSubmap

from toolkit.base.errors import SettingsError
from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_NAMES
from toolkit.runs.execution import check_settings
from toolkit.runs.settings import RunSettings
from toolkit.semantics.codes import binary_code, flat_code, one_hot_code
from toolkit.semantics.decoder import NetworkDecoder
from toolkit.semantics.options import NetworkOptions, SemanticLossWeights, SemanticsOptions
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.mapping.final_optimisation import step_count
from toolkit.slam.mapping.options import MapperOptions
from toolkit.slam.mapping.semantic_mapping import SemanticMapping, build_semantic_mapping
from toolkit.splatting.losses.semantic import SemanticLoss
from toolkit.splatting.rendering import RenderOptions, backend, render_surface

TREE = Taxonomy(
    {
        f"{i // 35}": {
            f"{j // 7}": list(CLASS_NAMES[j : j + 7])
            for j in range(i, min(i + 35, len(CLASS_NAMES)), 7)
        }
        for i in range(0, len(CLASS_NAMES), 35)
    },
    classes=CLASS_NAMES,
)
CODES = {"flat": flat_code, "one-hot": one_hot_code, "binary": binary_code}
FEW = MapperOptions(first_iterations=8, iterations=4, final_iterations=1)


def semantics(code: str = "one-hot", network: bool = False, **weights: float) -> SemanticMapping:
    chosen = CODES[code](TREE)
    generator = torch.Generator().manual_seed(0)
    trained = NetworkDecoder(chosen.channels, len(TREE), 32, 0.02, generator) if network else None
    loss = SemanticLoss(chosen, SemanticLossWeights(**weights), trained)
    return SemanticMapping(loss, "network" if network else "path")


def mapper_with(options: MapperOptions = FEW, **kinds) -> MappedSubmap:
    return MappedSubmap(options, np.random.default_rng(3), semantics=semantics(**kinds))


def accuracy(mapper: MappedSubmap, room, number: int) -> float:
    """Share of a frame's labelled pixels that the map shows right."""
    frame = room.frames[number]
    T_camera_map = se3.inverse(room.T_map_camera[number])
    view = render_surface(
        backend(), mapper.gaussians, frame.camera, T_camera_map, RenderOptions(features=True)
    )
    shown = mapper.mapper.semantics.decode_view(view).class_ids.reshape(frame.labels.shape)
    return float((shown == frame.labels)[frame.labels > 0].mean())


@pytest.mark.parametrize("code", CODES)
def test_a_map_renders_the_labels_of_its_keyframes(room, code):
    mapper = fed(mapper_with(code=code), room, [0, 4, 8])
    assert accuracy(mapper, room, 4) > 0.97
    assert accuracy(mapper, room, 6) > 0.93  # never mapped


def test_a_view_can_be_decoded_among_some_classes_alone(room):
    mapper = fed(mapper_with(), room, [0, 4])
    frame, T_camera_map = room.frames[4], se3.inverse(room.T_map_camera[4])
    options = RenderOptions(features=True)
    view = render_surface(backend(), mapper.gaussians, frame.camera, T_camera_map, options)
    usual = mapper.mapper.semantics.decode_view(view).class_ids
    kept = np.unique(usual[usual > 0])[::2]
    chosen = mapper.mapper.semantics.decode_view(view, among=kept).class_ids
    assert set(np.unique(chosen[usual > 0])) == set(kept)
    np.testing.assert_array_equal(chosen[np.isin(usual, kept)], usual[np.isin(usual, kept)])
    assert not chosen[usual == 0].any()


def test_wrong_labels_are_voted_out(room):
    """One keyframe in five calls the floor a sofa, from the first on."""
    sofa, floor = (CLASS_NAMES.index(n) + 1 for n in ("sofa", "floor"))

    def floor_share(mapper: MappedSubmap) -> float:
        answer = mapper.mapper.semantics.decode_gaussians(mapper.gaussians.features)
        chosen = np.isin(answer.class_ids, [sofa, floor])
        return float((answer.class_ids[chosen] == floor).mean())

    # Four iterations in images of this size; more of them correct the labels themselves.
    mapper = mapper_with(replace(FEW, iterations=1, final_iterations=0))
    for number in (0, 2, 4, 6, 8):
        frame = room.frames[number]
        if number == 0:
            labels = np.where(frame.labels == floor, sofa, frame.labels).astype(np.int32)
            frame = replace(frame, labels=labels)
        mapper.add_keyframe(Keyframe.from_frame(frame, room.T_map_camera[number]))
    assert floor_share(mapper) < 0.9
    mapper.refine()
    assert floor_share(mapper) > 0.95


def test_a_class_that_only_a_frame_between_keyframes_shows_keeps_its_name(room):
    mapper = fed(mapper_with(), room, [0])
    frame, new = room.frames[4], CLASS_NAMES.index("sofa") + 1
    assert not (room.frames[0].labels == new).any()
    mask = np.zeros(frame.labels.shape, bool)
    mask[:20, :20] = frame.depth_m[:20, :20] > 0
    count = len(mapper.gaussians)
    relabelled = replace(frame, labels=np.full_like(frame.labels, new))
    mapper.mapper.densification.seed_pixels(
        mapper.submap, relabelled, room.T_map_camera[4], mask, mapper.keyframes[0]
    )
    decoded = mapper.mapper.semantics.decode_gaussians(mapper.gaussians.features[count:])
    assert len(decoded.class_ids)
    assert (decoded.class_ids == new).all()


def test_votes_fit_a_gaussian_that_several_classes_show_through():
    """Three quarters floor, one quarter wall: that is what its heads say."""
    for make in (flat_code, one_hot_code, binary_code):
        code = make(TREE)
        words = code.codewords
        votes = (0.75 * words[40] + 0.25 * words[93])[None] * 400.0
        values = code.from_votes(votes, torch.tensor([400.0]))
        first, width = int(code.heads.first[0]), int(code.heads.width[0])
        head = values[0, first : first + width]
        shares = head.sigmoid() if code.heads.bits else head.softmax(0)
        expected = votes[0, first : first + width] / 400.0
        assert torch.allclose(shares, expected, atol=2e-3)


def test_the_final_refinement_compares_labels_in_every_step(room, monkeypatch):
    compared = []
    compute = SemanticMapping.add_gradient

    def noted(self, view, labels, progress, gradient):
        compared.append(labels is not None)
        return compute(self, view, labels, progress, gradient)

    monkeypatch.setattr(SemanticMapping, "add_gradient", noted)
    mapper = fed(mapper_with(), room, [0, 4])
    assert compared.count(False) >= len(compared) // 2
    compared.clear()
    mapper.refine()
    assert len(compared) == step_count(FEW, 2) and all(compared)


@pytest.mark.parametrize(
    ("keyframes", "steps"), [(0, 0), (1, 96), (10, 120), (40, 480), (100, 840), (1000, 6240)]
)
def test_submaps_of_few_keyframes_are_refined_longer(keyframes, steps):
    assert step_count(MapperOptions(final_iterations=6), keyframes) == steps
    spheres = MapperOptions(final_iterations=6, final_shape="spheres")
    assert step_count(spheres, keyframes) == 6 * keyframes


def test_geometry_does_not_hear_of_semantics(room):
    # Cells do not span classes, so that the two maps differ in a few Gaussians at borders;
    # with the very same seeds, every value of geometry is the same.
    single = replace(FEW, seeding=replace(FEW.seeding, max_cell=1))
    plain = fed(MappedSubmap(single, np.random.default_rng(3)), room, [0, 4])
    mapper = fed(mapper_with(single), room, [0, 4])
    for name in ("means", "log_radii", "opacity_logits", "colours"):
        one, other = getattr(plain.gaussians, name), getattr(mapper.gaussians, name)
        assert torch.allclose(one, other, atol=1e-5), name


def test_the_papers_gradients_reach_geometry(room):
    single = replace(FEW, seeding=replace(FEW.seeding, max_cell=1))
    free = fed(mapper_with(single, moves_geometry=True, weight=5.0), room, [0])
    still = fed(mapper_with(single, weight=5.0), room, [0])
    assert (free.gaussians.means - still.gaussians.means).abs().max() > 1e-5


def test_the_network_learns_while_mapping(room):
    options = replace(FEW, iterations=12, first_iterations=60)
    mapper = fed(mapper_with(options, network=True, inter_from=2), room, [0, 3, 6])
    assert accuracy(mapper, room, 3) > 0.9


def test_a_restored_map_goes_on_with_the_same_bits(room):
    mapper = fed(mapper_with(network=True, inter_from=1), room, [0, 3])
    arrays, values = mapper.state()
    other = mapper_with(network=True, inter_from=1)
    other.restore({name: array.copy() for name, array in arrays.items()}, values)
    for one in (mapper, other):
        fed(one, room, [7])
        one.refine()
    assert same_bits(mapper, other)


def test_frames_without_labels_leave_features_alone(room):
    mapper = fed(mapper_with(), room, [0])
    before = mapper.gaussians.features.clone()
    bare = replace(room.frames[1], labels=None)
    mapper.add_keyframe(Keyframe.from_frame(bare, room.T_map_camera[1]))
    answer = mapper.mapper.semantics.decode_gaussians(mapper.gaussians.features)
    assert (answer.class_ids[: len(before)] > 0).mean() > 0.99


def test_a_map_without_semantics_keeps_no_labels(room):
    mapper = fed(MappedSubmap(FEW), room, [0])
    assert mapper.keyframes[0].class_ids is None
    assert mapper.gaussians.features.shape[1] == 0


def test_a_network_that_is_not_trained_cannot_decode():
    """The path through the tree would decode instead, and nobody would know."""
    options = SemanticsOptions(reader="network")
    with pytest.raises(SettingsError, match=r"--semantics\.network\.use"):
        build_semantic_mapping(options, None, 0)
    with pytest.raises(SettingsError, match="not trained"):
        check_settings(RunSettings(semantics=options))
    trained = replace(options, network=NetworkOptions(use=True))
    check_settings(RunSettings(semantics=trained))
