"""Splats as OpenUSD: round trips, the schema, stages of other programs."""

from __future__ import annotations

import json
import sys
import zipfile
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from splat_examples import (
    COUNT,
    NOTES,
    TILTED,
    TREE,
    assert_same_labels,
    assert_same_splats,
    ellipsoids,
    image_of,
    labels,
    one_line,
    spheres,
)

from toolkit.base.errors import DependencyError, FormatError, RunFolderError
from toolkit.base.geometry import se3
from toolkit.io.splat_placement import HALF_TURN
from toolkit.io.splats import (
    export_splat_scene,
    export_splats,
    is_splat_file,
    read_splats,
    write_splat_ply,
)
from toolkit.runs.maps.splat_clouds import read_cloud
from toolkit.splatting.gaussians.cloud import LOW_PASS_3DGS

pytest.importorskip("pxr.UsdVol", reason="needs usd-core: pip install 'semsplat[usd]'")

from pxr import Gf, Usd, UsdGeom, UsdValidation, UsdVol, Vt

MINIMAL = """#usda 1.0
def ParticleField3DGaussianSplat "a"
{
    point3f[] positions = [(1, 2, 3), (4, 5, 6)]
    float3[] scales = [(1, 2, 3), (4, 5, 6)]
    uniform int radiance:sphericalHarmonicsDegree = 0
    float3[] radiance:sphericalHarmonicsCoefficients = [(0, 0, 0), (1, 0, -1)]
}
"""


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usd", ".usdz"])
@pytest.mark.parametrize("placement", [HALF_TURN, TILTED], ids=["level", "tilted"])
@pytest.mark.parametrize("degree", [None, 0, 3])
def test_a_map_with_labels_is_read_as_it_was_written(tmp_path, suffix, placement, degree):
    cloud = spheres() if degree is None else ellipsoids(degree)
    path, scene = tmp_path / f"map{suffix}", replace(NOTES, T_scene_map=placement)
    export_splat_scene(path, cloud, labels().columns(), scene)
    assert is_splat_file(path)
    read = read_splats(path)
    assert_same_splats(read, cloud)
    assert_same_labels(read.labels, labels())
    assert json.dumps(read.taxonomy) == json.dumps(TREE)  # in the same order
    content = path.read_bytes()
    export_splat_scene(path, cloud, labels().columns(), scene)
    assert path.read_bytes() == content
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_the_layout_is_that_of_the_schema(tmp_path):
    cloud = ellipsoids(1).select(torch.tensor([0]))
    shapes = replace(
        cloud.ellipsoids,
        log_scales=torch.tensor([[0.1, 0.2, 0.3]]).log(),
        rotations=torch.tensor([[0.0, 0.0, 2.0, 0.0]]),
        harmonics=torch.tensor([[[0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3]]]),
    )
    one = replace(
        cloud,
        means=torch.tensor([[1.0, 2.0, 3.0]]),
        opacity_logits=torch.tensor([0.75]).logit(),
        colours=torch.tensor([[0.0, 0.5, 1.0]]),
        ellipsoids=shapes,
        low_pass=LOW_PASS_3DGS,
    )
    export_splat_scene(tmp_path / "a.usda", one, {"label": np.array([-3])}, NOTES)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    prim = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/Map/Splats"))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetDefaultPrim().GetPath() == "/Map"
    own = stage.GetRootLayer().customLayerData["semsplat"]
    assert list(own["comments"]) == ["origin_m 1 2 3", "a note"]
    assert own["classes"] == {"1": "chair", "2": "Tür"}
    assert list(prim.GetPositionsAttr().Get()) == [Gf.Vec3f(1, -2, -3)]
    assert list(prim.GetOrientationsAttr().Get()) == [Gf.Quatf(0, 0, -1, 0)]
    np.testing.assert_allclose(prim.GetScalesAttr().Get(), [[0.1, 0.2, 0.3]], rtol=1e-6)
    assert list(prim.GetOpacitiesAttr().Get()) == [0.75]
    assert prim.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 1
    coefficients = [[-1.7724538, 0, 1.7724538], [-0.1, 0, 0], [0, -0.2, 0], [0, 0, 0.3]]
    found = prim.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()
    np.testing.assert_allclose(found, coefficients, atol=1e-6)
    extent = [[0.1, -2.9, -3.9], [1.9, -1.1, -2.1]]
    np.testing.assert_allclose(prim.GetExtentAttr().Get(), extent, rtol=1e-6)
    assert Usd.ColorSpaceAPI(prim).GetColorSpaceNameAttr().Get() == "srgb_rec709_scene"
    assert list(UsdGeom.PrimvarsAPI(prim).GetPrimvar("label").Get()) == [-3]


def test_all_validators_of_usd_accept_the_file(tmp_path):
    scene = replace(NOTES, T_scene_map=TILTED)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    for suffix in (".usda", ".usdc", ".usdz"):
        path = tmp_path / f"a{suffix}"
        export_splat_scene(path, ellipsoids(3), labels().columns(), scene)
        stage = Usd.Stage.Open(str(path))
        found = UsdValidation.ValidationContext(validators).Validate(stage)
        assert [error.GetMessage() for error in found] == []
    assert len(zipfile.ZipFile(path).infolist()) == 1


def test_the_validators_find_errors(tmp_path):
    (tmp_path / "a.usda").write_text(MINIMAL)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert UsdValidation.ValidationContext(validators).Validate(stage)


def test_a_stage_of_another_program_is_turned_with_its_prim(tmp_path):
    """Also its harmonics, from axes with z up and centimetres."""
    cloud = replace(ellipsoids(3), low_pass=LOW_PASS_3DGS)
    export_splats(tmp_path / "a.usda", cloud)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    stage.GetRootLayer().customLayerData = {}
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    T = se3.exp(np.array([10.0, -20, 30, 0.5, -0.9, 0.4]))
    matrix = T.copy()
    matrix[:3, :3] *= 100.0
    op = UsdGeom.Xformable(stage.GetPrimAtPath("/Map")).AddTransformOp()
    op.Set(Gf.Matrix4d(*matrix.T.ravel().tolist()))
    stage.GetRootLayer().Export(str(tmp_path / "b.usdc"))
    read = read_cloud(tmp_path / "b.usdc")
    T[:3, 3] /= 100.0
    y_up = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    moved = cloud.transformed(HALF_TURN @ y_up @ T @ HALF_TURN)
    torch.testing.assert_close(read.means, moved.means, atol=1e-5, rtol=1e-5)
    back = read.transformed(np.linalg.inv(HALF_TURN @ y_up @ T @ HALF_TURN))
    assert float((image_of(back) - image_of(cloud)).abs().max()) < 1e-3
    assert float((image_of(read) - image_of(cloud)).abs().max()) > 0.1


def test_what_is_missing_has_the_default_of_the_schema(tmp_path):
    (tmp_path / "a.usda").write_text(MINIMAL)
    read = read_splats(tmp_path / "a.usda")
    np.testing.assert_array_equal(read.means, [[1, -2, -3], [4, -5, -6]])
    assert (read.opacity_logits > 16).all()
    np.testing.assert_array_equal(read.ellipsoids.rotations, [[1, 0, 0, 0]] * 2)
    np.testing.assert_allclose(read.colours, [[0.5] * 3, [0.782, 0.5, 0.218]], atol=1e-3)
    # Arrays that are too short are ignored, longer ones are cut.
    for line in ("float[] opacities = [0.5]", "float[] opacities = []"):
        (tmp_path / "a.usda").write_text(MINIMAL.replace("{", "{\n" + line, 1))
        assert (read_splats(tmp_path / "a.usda").opacity_logits > 16).all()
    long = MINIMAL.replace("{", "{\nhalf[] opacitiesh = [0.5, 0.25, 1]", 1)
    (tmp_path / "a.usda").write_text(long)
    logits = read_splats(tmp_path / "a.usda").opacity_logits
    np.testing.assert_allclose(logits, [0, -np.log(3)], atol=1e-6)


def test_half_precision_samples_and_instances_are_read(tmp_path):
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/Model/Splats")
    field.CreatePositionshAttr(Vt.Vec3hArray([Gf.Vec3h(1, 2, 3)]))
    field.CreateOrientationshAttr(Vt.QuathArray([Gf.Quath(0, 0, 1, 0)]))
    field.CreateScaleshAttr().Set(Vt.Vec3hArray([Gf.Vec3h(1, 2, 4)]), 7.0)
    field.CreateRadianceSphericalHarmonicsDegreeAttr(0)
    field.CreateRadianceSphericalHarmonicsCoefficientshAttr(Vt.Vec3hArray([Gf.Vec3h(0, 0, 0)]))
    for k in (1, 2):
        instance = UsdGeom.Xform.Define(stage, f"/Instance{k}")
        instance.GetPrim().GetReferences().AddInternalReference("/Model")
        instance.GetPrim().SetInstanceable(True)
        instance.AddTranslateOp().Set(Gf.Vec3d(10.0 * k, 0, 0))
    stage.GetRootLayer().Save()
    read = read_splats(tmp_path / "a.usda")
    np.testing.assert_array_equal(np.sort(read.means[:, 0]), [1, 11, 21])
    np.testing.assert_allclose(np.exp(read.ellipsoids.log_scales), [[1, 2, 4]] * 3, rtol=1e-6)
    np.testing.assert_allclose(np.abs(read.ellipsoids.rotations), [[0, 0, 1, 0]] * 3)


def test_truncated_files_are_refused(tmp_path, capfd):
    for suffix in (".usda", ".usdc", ".usdz"):
        path, cut = tmp_path / f"a{suffix}", tmp_path / f"cut{suffix}"
        export_splats(path, spheres().select(torch.arange(2)))
        content = path.read_bytes().rstrip(b"\n")
        for length in (*range(0, len(content) - 1, 397), len(content) - 1):
            cut.write_bytes(content[:length])
            with pytest.raises(FormatError) as error:
                read_splats(cut)
            assert one_line(error.value, cut), error.value
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("ParticleField3DGaussianSplat", "Points", "contains no splats"),
        ("[(1, 2, 3), (4, 5, 6)]\n    float3", "[]\n    float3", "/a contains no splats"),
        ("Degree = 0", "Degree = 4", "degree 4, instead of 0 to 3"),
        ("(1, 2, 3)", "(nan, 2, 3)", None),
        ("{", "{\ndouble3 xformOp:scale = (1, -1, 1)\n"
            'token[] xformOpOrder = ["xformOp:scale"]', "is mirrored, skewed or scaled"),
        ("#usda 1.0", "#usda 9.0", "is no USD file, or is damaged"),
    ],
)  # fmt: skip
def test_damaged_files_are_explained_in_one_line(tmp_path, old, new, words, caplog):
    path = tmp_path / "a.usda"
    path.write_text(MINIMAL.replace(old, new, 1))
    if words is None:
        assert len(read_splats(path)) == 1
        assert "1 of 2 splats are not finite" in caplog.text
        return
    with pytest.raises(FormatError, match=words) as error:
        read_splats(path)
    assert one_line(error.value, path)


def test_colours_of_other_spaces_are_converted(tmp_path, caplog):
    head = 'def ParticleField3DGaussianSplat "a" (prepend apiSchemas = ["ColorSpaceAPI"])'
    text = MINIMAL.replace('def ParticleField3DGaussianSplat "a"', head)
    for name, colour in (("lin_rec709_scene", 0.7354), ("srgb_rec709_display", 0.5)):
        space = f'{{\nuniform token colorSpace:name = "{name}"'
        (tmp_path / "a.usda").write_text(text.replace("{", space, 1))
        assert read_splats(tmp_path / "a.usda").colours[0, 0] == pytest.approx(colour, abs=1e-4)
    assert caplog.text.count("are converted to sRGB") == 1


def test_usd_and_ply_look_the_same(tmp_path):
    cloud = ellipsoids(3)
    write_splat_ply(tmp_path / "a.ply", cloud)
    export_splats(tmp_path / "a.usdz", cloud)
    images = [image_of(read_cloud(tmp_path / name)) for name in ("a.ply", "a.usdz")]
    torch.testing.assert_close(images[0], images[1], atol=1e-5, rtol=0)


def test_a_missing_package_is_named(tmp_path, monkeypatch):
    export_splats(tmp_path / "a.usda", spheres())
    monkeypatch.setitem(sys.modules, "pxr", None)
    for job in (read_splats, lambda path: export_splats(path, spheres())):
        with pytest.raises(DependencyError, match=r"pip install 'semsplat\[usd\]'") as error:
            job(tmp_path / "a.usda")
        assert one_line(error.value, tmp_path / "a.usda")


def test_a_folder_that_is_missing_is_named(tmp_path):
    with pytest.raises(RunFolderError, match="cannot write") as error:
        export_splats(tmp_path / "gone/a.usdz", spheres())
    assert one_line(error.value, tmp_path / "gone/a.usdz")


def test_arrays_of_usd_do_not_outlive_the_stage(tmp_path):
    """Values that are read are copies, in memory of their own."""
    export_splats(tmp_path / "a.usdc", spheres(), {"label": np.arange(COUNT)})
    columns: dict[str, Any] = read_splats(tmp_path / "a.usdc").extra
    (tmp_path / "a.usdc").write_bytes(b"")
    np.testing.assert_array_equal(columns["label"], np.arange(COUNT))


def test_binary_files_that_state_too_much_or_crash_openusd_are_refused(tmp_path):
    """They would end this process if it read them."""
    path = tmp_path / "a.usdc"
    export_splats(path, spheres())
    content = path.read_bytes()
    contents = int.from_bytes(content[16:24], "little")
    tokens = int.from_bytes(content[contents + 24 : contents + 32], "little")
    values = (2**40).to_bytes(8, "little")
    for place in (tokens, tokens + 8):
        path.write_bytes(content[:place] + values + content[place + 8 :])
        with pytest.raises(FormatError, match="cannot be read"):
            read_splats(path)
