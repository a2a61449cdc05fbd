"""Classes of rooms from depth alone: input, network, votes of views, and the whole segmenter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from box_room import CEILING, FLOOR, SURFACE, WALL, LabelledView, looking, see, walk
from safetensors.torch import save_file

from toolkit.base.errors import FormatError
from toolkit.base.geometry import se3
from toolkit.semantics.segmenters.geometric.surface_grid import surface_grid
from toolkit.semantics.segmenters.indoor.channels import COUNT, indoor_channels
from toolkit.semantics.segmenters.indoor.classes import (
    INDOOR_CLASSES,
    INDOOR_GROUPS,
    INDOOR_KINDS,
    OTHER_FURNITURE,
)
from toolkit.semantics.segmenters.indoor.network import IndoorNetwork, IndoorWeights, load_weights
from toolkit.semantics.segmenters.indoor.segmenter import (
    IndoorSegmenter,
    _join_pieces,
    _sure_classes,
)
from toolkit.semantics.segmenters.indoor.votes import VOXEL_M, ClassVotes
from toolkit.semantics.trees import shipped_taxonomy

UP = np.array([0.0, -1.0, 0.0])


def identifiers(*names: str) -> list[int]:
    return [INDOOR_CLASSES.index(name) + 1 for name in names]


def segmented(segmenter: IndoorSegmenter, views: list[LabelledView]) -> list[np.ndarray]:
    T_map_world = se3.inverse(views[0].T_world_camera)
    return [segmenter.segment(v.frame, T_map_world @ v.T_world_camera) for v in views]


def recall(views: list[LabelledView], labels: list[np.ndarray], true: int, *names: str) -> float:
    there = np.concatenate([v.classes[v.frame.depth_m > 0] for v in views]) == true
    found = np.concatenate([ids[v.frame.depth_m > 0] for v, ids in zip(views, labels, strict=True)])
    return float(np.isin(found[there], identifiers(*names)).mean())


def test_groups_and_kinds_are_those_of_the_bundled_tree():
    tree = shipped_taxonomy("indoor")
    assert tree.classes == (*INDOOR_CLASSES, OTHER_FURNITURE)
    for numbers, level in ((INDOOR_KINDS, 0), (INDOOR_GROUPS, 1)):
        names = [tree.ancestor(k + 1, level).name for k in range(len(INDOOR_CLASSES))]
        same = np.equal.outer(names, names)
        assert (np.equal.outer(numbers, numbers) == same).all()


def test_channels_are_those_of_a_level_floor():
    view = see(looking((0.0, -1.0, 1.5), (0.0, 1.9, 0.0)))
    grid = surface_grid(view.frame.depth_m, view.frame.camera)
    up = view.T_world_camera[2, :3]
    channels = indoor_channels(grid, up, -1.5)
    floor = (view.classes == FLOOR) & grid.oriented
    wall = (view.classes == WALL) & grid.oriented
    assert channels.shape == (COUNT, *view.classes.shape)
    assert np.median(channels[0][floor]) == pytest.approx(-0.5, abs=0.01)
    assert np.median(channels[1][floor]) == pytest.approx(1.0, abs=0.01)
    assert np.median(channels[1][wall]) == pytest.approx(0.0, abs=0.01)
    # An unknown floor is the lowest surface in view.
    np.testing.assert_allclose(indoor_channels(grid, up, None), channels, atol=0.02)


def test_channels_without_depth_are_zero():
    view = see(looking((0.0, -1.0, 1.5), (0.0, 1.9, 0.0)))
    depth_m = view.frame.depth_m.copy()
    depth_m[:60] = 0.0
    channels = indoor_channels(surface_grid(depth_m, view.frame.camera), UP, None)
    assert (channels[:, :60] == 0.0).all()
    empty = indoor_channels(surface_grid(depth_m * 0.0, view.frame.camera), UP, None)
    assert (empty == 0.0).all()


@pytest.mark.parametrize("size", [(85, 150), (120, 160), (160, 90), (17, 16)])
def test_the_network_labels_images_of_any_size(size):
    weights = IndoorWeights(IndoorNetwork(4).eval(), np.zeros((6, 4), np.float32), "")
    with torch.no_grad():
        log_p = weights.log_probabilities(torch.rand(COUNT, *size))
    assert log_p.shape == (4, *size)
    torch.testing.assert_close(log_p.exp().sum(dim=0), torch.ones(size))


def test_loaded_weights_give_what_the_trained_network_gave(tmp_path):
    torch.manual_seed(0)
    network = IndoorNetwork(len(INDOOR_CLASSES))
    network(torch.rand(2, COUNT, 32, 32))  # statistics of the normalisation
    tensors = {name: value.contiguous() for name, value in network.state_dict().items()}
    tensors["structure"] = torch.zeros(6, len(INDOOR_CLASSES))
    path = tmp_path / "w.safetensors"
    save_file(tensors, path, {"classes": ",".join(INDOOR_CLASSES)})
    image = torch.rand(1, COUNT, 32, 48)
    with torch.no_grad():
        expected = torch.log_softmax(network.eval()(image)[0], dim=0)
        found = load_weights(path).log_probabilities(image[0])
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(
    ("tensors", "classes", "named"),
    [
        ({"structure": torch.zeros(6, 2)}, "floor,wall", "other classes"),
        ({"structure": torch.zeros(6, 22)}, ",".join(INDOOR_CLASSES), "another network"),
    ],
)
def test_weights_of_something_else_are_refused(tmp_path, tensors, classes, named):
    path = tmp_path / "w.safetensors"
    save_file(tensors, path, {"classes": classes})
    with pytest.raises(FormatError, match=named):
        load_weights(path)
    path.write_bytes(b"none")
    with pytest.raises(FormatError, match=r"w\.safetensors: not a file of weights"):
        load_weights(path)


class TestVotes:
    def test_a_place_remembers_what_views_said_of_it(self):
        votes = ClassVotes(2)
        here, there = np.full((3, 3), 0.01), np.full((1, 3), 1.0)
        sure, unsure = np.log([[0.9, 0.1]] * 3), np.log([[0.4, 0.6]])
        votes.add(here, sure.astype(np.float32))
        sums, views = votes.add(
            np.concatenate([there, here[:1]]), np.repeat(unsure, 2, 0).astype(np.float32)
        )
        np.testing.assert_allclose(sums[0], unsure[0], atol=1e-6)
        # One vote for a view, however many points of a voxel it shows.
        np.testing.assert_allclose(sums[1], sure[0] + unsure[0], atol=1e-6)
        assert views.tolist() == [1.0, 2.0] and len(votes) == 2

    def test_later_views_can_outvote_an_error(self):
        votes, point = ClassVotes(2), np.zeros((1, 3))
        for _ in range(200):
            votes.add(point, np.log([[0.99, 0.01]]).astype(np.float32))
        for _ in range(40):
            sums, _ = votes.add(point, np.log([[0.2, 0.8]]).astype(np.float32))
        assert sums[0].argmax() == 1

    def test_restored_votes_go_on_as_if_nothing_had_happened(self):
        rng = np.random.default_rng(0)
        views = [
            (rng.uniform(0, 5 * VOXEL_M, (50, 3)), np.log(rng.dirichlet(np.ones(4), 50)))
            for _ in range(4)
        ]
        whole, first, second = ClassVotes(4), ClassVotes(4), ClassVotes(4)
        for k, (points, log_p) in enumerate(views):
            whole_sums, _ = whole.add(points, log_p.astype(np.float32))
            if k == 2:
                second.restore(first.state())
            part = first if k < 2 else second
            sums, _ = part.add(points, log_p.astype(np.float32))
        assert np.array_equal(sums, whole_sums)


def test_a_room_is_taken_apart():
    views = walk()
    labels = segmented(IndoorSegmenter(), views)
    assert recall(views, labels, FLOOR, "floor") > 0.95
    assert recall(views, labels, WALL, "wall") > 0.9
    furniture = [n for n, kind in zip(INDOOR_CLASSES, INDOOR_KINDS, strict=True) if kind == 1]
    assert recall(views, labels, SURFACE, *furniture) > 0.8


def test_a_ceiling_is_no_floor():
    views = [*walk(4), see(looking((0.0, -0.6, 1.5), (1.0, 1.5, 2.4)))]
    labels = segmented(IndoorSegmenter(), views)
    assert recall(views[-1:], labels[-1:], CEILING, "ceiling") > 0.9


def test_pixels_without_depth_are_void():
    view = walk(1)[0]
    depth_m = view.frame.depth_m.copy()
    depth_m[:40] = 0.0
    labels = IndoorSegmenter().segment(replace(view.frame, depth_m=depth_m), np.eye(4))
    assert (labels[:40] == 0).all() and (labels[60:] > 0).any()
    nothing = replace(view.frame, depth_m=np.zeros_like(depth_m))
    assert (IndoorSegmenter().segment(nothing) == 0).all()


def test_what_is_farther_than_rooms_reach_is_void():
    view = see(looking((0.0, -1.0, 1.5), (0.0, 1.9, 0.0)))
    far = replace(view.frame, depth_m=np.float32(4.0) * view.frame.depth_m)
    segmenter = IndoorSegmenter()
    for pose in (None, np.eye(4)):
        labels = segmenter.segment(far, pose)
        assert (labels[far.depth_m < 9.0] > 0).mean() > 0.5
        # Pixels at borders of cells take the class of the cell whose plane fits best.
        assert (labels[far.depth_m > 11.0] > 0).mean() < 0.05


def test_a_frame_without_a_pose_changes_nothing():
    views, segmenter = walk(2), IndoorSegmenter()
    segmenter.segment(views[0].frame)
    assert len(segmenter._votes) == 0


def test_a_restored_segmenter_labels_the_same():
    views = walk(4)
    whole = segmented(IndoorSegmenter(), views)
    first, second = IndoorSegmenter(), IndoorSegmenter()
    T_map_world = se3.inverse(views[0].T_world_camera)
    for v in views[:2]:
        first.segment(v.frame, T_map_world @ v.T_world_camera)
    second.restore(first.state())
    for v, expected in zip(views[2:], whole[2:], strict=True):
        found = second.segment(v.frame, T_map_world @ v.T_world_camera)
        assert np.array_equal(found, expected)


def test_a_class_is_named_as_far_as_it_is_sure():
    def named(**p: float) -> str:
        rest = (1.0 - sum(p.values())) / (len(INDOOR_CLASSES) - len(p))
        values = np.array([[p.get(name, rest) for name in INDOOR_CLASSES]], np.float32)
        (found,) = _sure_classes(np.log(values))
        return "void" if found == 0 else (*INDOOR_CLASSES, OTHER_FURNITURE)[found - 1]

    assert named(table=0.9) == "table"
    # Sure of the group: its likelier class.
    assert named(table=0.3, desk=0.25, wall=0.35) == "table"
    assert named(bed=0.3, sofa=0.3, table=0.3) == OTHER_FURNITURE
    assert named(wall=0.45, bed=0.3, thing=0.25) == "void"


def test_a_sofa_whose_end_looks_like_a_bed_is_a_sofa():
    valid = np.ones((3, 12), bool)
    p = np.full((3, 12, len(INDOOR_CLASSES)), 1e-3, np.float32)
    sofa, bed, wall = (number - 1 for number in identifiers("sofa", "bed", "wall"))
    p[:, :5, sofa], p[:, :5, bed] = 0.7, 0.2
    p[:, 5:7, sofa], p[:, 5:7, bed] = 0.4, 0.5
    p[:, 7:9, wall] = 0.9
    p[:, 9:, sofa], p[:, 9:, bed] = 0.3, 0.6
    log_p = np.log(p.reshape(36, -1))
    _join_pieces(log_p, valid)
    joined = np.exp(log_p).reshape(p.shape)
    assert (joined.argmax(axis=2)[:, :7] == sofa).all()
    # A bed behind a wall remains one, and nobody gains or loses.
    assert np.allclose(joined[:, 7:], p[:, 7:], atol=1e-6)
    assert np.allclose(joined.sum(axis=2), p.sum(axis=2), atol=1e-5)
