"""What the viewer shows: thinning, names and the binary form."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from painted_scenes import CAMERA, tree, two_panels

from toolkit.base.errors import ToolkitError
from toolkit.base.exposure import IDENTITY
from toolkit.base.keyframe import Keyframe
from toolkit.io.splat_shapes import SplatShapes, relative_covariances
from toolkit.splatting.gaussians.ellipsoids import Ellipsoids
from toolkit.tools.viewer.keyframes import DepthEvidence
from toolkit.tools.viewer.options import ShownContent
from toolkit.tools.viewer.packing import pack
from toolkit.tools.viewer.reading import read_scene
from toolkit.tools.viewer.scene import (
    DOUBTFUL,
    HARMONIC_STEPS,
    INTERRUPTED,
    PATH_RGB,
    ViewerScene,
    path_states,
)
from toolkit.tools.viewer.shapes import shape_columns
from toolkit.tools.viewer.thinning import thin


def test_a_run_is_described_with_classes_cameras_and_images(tiny_run):
    scene = read_scene(tiny_run, ShownContent(max_gaussians=500, images=2, image_width=32))
    assert len(scene.splats) == 500 < scene.total
    assert scene.tree is not None
    assert scene.splats.levels.shape == (500, len(scene.tree.levels))
    assert scene.path.shape == (6, 4, 4)
    images = [k.image for k in scene.keyframes if k.image is not None]
    assert 1 <= len(images) <= 2
    assert images[0].shape == (24, 32, 3)
    assert scene.splats.inferred is None, "a run with a depth sensor has measured content only"
    assert np.isclose(np.linalg.norm(scene.up), 1.0)


def test_a_splat_file_is_described_without_cameras(tiny_run, tmp_path):
    copy = tmp_path / "map.ply"
    shutil.copy(tiny_run / "map.ply", copy)
    alone = read_scene(copy, ShownContent())
    assert alone.tree is None and alone.splats.levels is None and not alone.keyframes
    in_run = read_scene(tiny_run / "map.ply", ShownContent())
    assert in_run.tree is not None, "the taxonomy lies beside this file"


@pytest.mark.parametrize("name", ["missing", "empty", "unfinished"])
def test_a_folder_without_a_map_is_reported(tiny_run, tmp_path, name):
    path = tmp_path / name
    if name == "empty":
        path.mkdir()
    if name == "unfinished":
        shutil.copytree(tiny_run, path)
        (path / "frames.json").unlink()
    with pytest.raises(ToolkitError, match=name):
        read_scene(path, ShownContent())


def test_thinning_leaves_no_holes():
    """Small Gaussians on the right half represent its surface, though the left ones are larger."""
    rng = np.random.default_rng(1)
    means_m = rng.uniform(0.0, 1.0, (4000, 3)).astype(np.float32)
    visible = np.where(means_m[:, 0] < 0.5, 1.0, 0.2)
    result = thin(means_m, visible, 1000)
    assert len(result.index) == 1000 and len(np.unique(result.index)) == 1000
    right = (means_m[result.index, 0] > 0.5).sum()
    assert 100 < right < 250
    assert (result.growth >= 1.0).all() and result.growth.max() > result.growth.min()
    assert (np.diff(visible[result.index]) <= 0.0).all(), "the most visible come first"
    again = thin(means_m, visible, 1000)
    assert (again.index == result.index).all()


def test_a_small_map_is_not_thinned():
    splats = two_panels(20).splats
    kept = splats.thinned(20)
    assert len(kept) == 20 and (kept.sigmas_m == splats.sigmas_m[0]).all()


def test_names_are_found():
    shown = tree()
    names = {text: [shown.nodes[i].path[-1] for i in shown.matching(text)] for text in (
        "Chair", "ture", "table, wall", "furniture > t", "sofa", " "
    )}  # fmt: skip
    assert names["Chair"] == ["chair"]
    assert set(names["ture"]) == {"furniture", "structure"}
    assert set(names["table, wall"]) == {"table", "wall"}
    assert names["furniture > t"] == ["table"]
    assert names["sofa"] == names[" "] == []


def test_the_binary_form_keeps_positions_sizes_and_nodes():
    scene = two_panels()
    packed = pack(scene)
    json.dumps(packed.header, allow_nan=False)

    def array(name):
        place = packed.header["arrays"][name]
        return np.frombuffer(
            bytes(packed.data), place["type"], place["length"], place["offset"]
        ).astype(float)

    low, extent = np.array(packed.header["low"]), np.array(packed.header["extent"])
    means_m = low + array("means").reshape(-1, 3) / 65535.0 * extent
    assert np.abs(means_m - scene.splats.means_m).max() < extent.max() / 65000.0
    assert (scene.splats.levels == array("levels").reshape(2, -1).T).all()
    smallest, span = packed.header["logSigma"]
    sigmas_m = np.exp(smallest + array("sigmas") / 255.0 * span)
    assert sigmas_m == pytest.approx(scene.splats.sigmas_m, rel=0.05)


def test_positions_far_from_each_other_are_not_rounded():
    splats = two_panels(40).splats
    wide = splats.means_m.copy()
    wide[0] = (1e6, 0.0, 0.0)
    packed = pack(ViewerScene("wide", replace(splats, means_m=wide), 40))
    place = packed.header["arrays"]["means"]
    means_m = np.frombuffer(
        bytes(packed.data), place["type"], place["length"], place["offset"]
    ).reshape(-1, 3)
    assert (means_m == wide).all()


def test_inferred_gaussians_are_those_that_no_keyframe_measured():
    """In the first keyframe, the depth of the left half follows from a prior."""
    splats = replace(two_panels().splats, submap=None, inferred=None)
    left = splats.means_m[:, 0] < 0.0
    inferred = torch.zeros((60, 80), dtype=torch.bool)
    inferred[:, :40] = True
    keyframe = Keyframe(
        index=0,
        timestamp_s=0.0,
        T_map_camera=np.eye(4),
        rgb=torch.zeros((3, 60, 80), dtype=torch.uint8),
        depth_m=torch.full((60, 80), 2.0),
        camera=CAMERA,
        exposure=IDENTITY,
        points=np.zeros((0, 3), np.float32),
        inferred=inferred,
    )
    evidence = DepthEvidence(splats)
    assert evidence.inferred() is None
    evidence.add(keyframe, np.eye(4), 0)
    # Gaussians above and below the image are observed by nothing.
    seen = np.abs(splats.means_m[:, 1]) < 0.7
    assert (evidence.inferred()[seen] == left[seen]).all()
    evidence.add(replace(keyframe, inferred=None), np.eye(4), 0)
    assert evidence.inferred() is None, "a sensor has measured all of them by now"


def test_shapes_of_anisotropic_splats():
    """A quarter turn about z swaps the x and y axes of an ellipsoid."""
    scales_m = np.array([[0.2, 0.1, 0.05]])
    half = np.sqrt(0.5)
    turned = relative_covariances(scales_m, np.array([[half, 0.0, 0.0, half]]))
    upright = relative_covariances(scales_m, np.array([[2.0, 0.0, 0.0, 0.0]]))
    assert upright[0] == pytest.approx([4.0, 0.0, 0.0, 1.0, 0.0, 0.25])
    assert turned[0] == pytest.approx([1.0, 0.0, 0.0, 4.0, 0.0, 0.25], abs=1e-6)


def test_ellipsoids_of_clouds_and_of_files_have_the_same_columns():
    rng = np.random.default_rng(0)
    arrays = [rng.normal(size=shape).astype(np.float32) for shape in ((5, 3), (5, 4), (5, 3, 3))]
    of_file = shape_columns(SplatShapes(*arrays))
    of_cloud = shape_columns(Ellipsoids(*map(torch.from_numpy, arrays)))
    for name in ("shapes", "harmonics"):
        assert (of_file[name] == of_cloud[name]).all()
    assert of_file["harmonics"] == pytest.approx(arrays[2].clip(-1, 1) * HARMONIC_STEPS, abs=0.51)
    none = SplatShapes(arrays[0], arrays[1], np.zeros((5, 3, 3), np.float32))
    assert "harmonics" not in shape_columns(none) and shape_columns(None) == {}


def test_ways_to_and_from_doubtful_frames_and_over_missing_ones_are_marked():
    states = path_states([2, 3, 4, 5, 8, 9], doubtful={4}, absent={0, 1, 6, 7, 10})
    assert states.tolist() == [0, 0, DOUBTFUL, DOUBTFUL, INTERRUPTED, 0]
    assert path_states([], set(), {1}).tolist() == []
    assert path_states([0], {0}, set()).tolist() == [DOUBTFUL]


def test_a_path_of_unknown_states_has_one_colour():
    scene = two_panels(40)
    assert scene.path_colours.tolist() == [list(PATH_RGB[0])] * (len(scene.path) - 1)
    marked = replace(scene, path_states=np.array([0, INTERRUPTED, DOUBTFUL], np.uint8))
    expected = [list(PATH_RGB[INTERRUPTED]), list(PATH_RGB[DOUBTFUL])]
    assert marked.path_colours.tolist() == expected
    packed = pack(marked)
    place = packed.header["arrays"]["pathColours"]
    assert place["length"] == 6 and place["type"] == "uint8"
