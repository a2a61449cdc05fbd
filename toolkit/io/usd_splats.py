"""Gaussian splats as OpenUSD (`.usda`, `.usdc`, `.usd`, `.usdz`) with ParticleField3DGaussianSplat.

Source: the schema usdVol of OpenUSD 26.03 and later. Scales are linear, opacities are in [0, 1],
and harmonics are those of 3DGS with the constant first, contiguous for each splat. Labels and other
columns are primvars.
"""

from __future__ import annotations

import json
import logging
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DependencyError, FormatError, RunFolderError
from toolkit.base.geometry.harmonics import HARMONIC_COUNTS
from toolkit.io.atomic import replacing
from toolkit.io.guarded.archive import Archive
from toolkit.io.guarded.content import DamagedError, check_regular
from toolkit.io.guarded.documents import parse_json
from toolkit.io.splat_columns import OWN_COLUMNS, Columns, logits, opacities_of
from toolkit.io.splat_placement import (
    HALF_TURN,
    SplatNotes,
    SplatScene,
    concatenated,
    constant_colours,
    in_srgb,
    linear_from_srgb,
    placed,
)
from toolkit.io.usd_layers import check_layers

_log = logging.getLogger(__name__)

_TYPE = "ParticleField3DGaussianSplat"
_COLOUR_SPACE, _LINEAR = "srgb_rec709_scene", "lin_rec709_scene"
# Key of our values in the layer's custom data.
_OWN = "semsplat"
# Splats end at this many standard deviations.
_EXTENT = 3.0
# The date of the layer in a .usdz, so that the same map gives the same file: 2 January 1980.
_PACKAGE_DATE = 315_619_200
# From z up to y up.
_Y_FROM_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def write_usd_splats(
    path: Path, columns: Columns, extra: Mapping[str, NDArray], scene: SplatScene
) -> None:
    """Write splats as USD: text (`.usda`), binary (`.usdc`, `.usd`) or a package (`.usdz`).

    Args:
        columns: the splats in the frame of the map; see `splat_columns`.
        extra: additional columns [N] by name; integers as int, other types as float.
        scene: placement, class tree and comments.

    Raises:
        DependencyError: usd-core is missing or too old.
        RunFolderError: the file cannot be written.
    """
    pxr = _pxr(path)
    stage = pxr.Usd.Stage.CreateInMemory()
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.y)
    if scene.metric:
        pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    own: dict[str, Any] = {"T_usd_map": _matrix(pxr, scene.T_scene_map)}
    if scene.comments:
        own["comments"] = pxr.Vt.StringArray(list(scene.comments))
    if scene.taxonomy is not None:
        own["classes"] = scene.classes
        # Dictionaries of USD are sorted, but nodes are numbered by the order of the tree.
        own["taxonomy"] = json.dumps(scene.taxonomy, ensure_ascii=False)
    stage.GetRootLayer().customLayerData = {_OWN: own}
    root = pxr.UsdGeom.Xform.Define(stage, "/Map")
    stage.SetDefaultPrim(root.GetPrim())
    pxr.Usd.ModelAPI(root).SetKind(pxr.Kind.Tokens.component)
    if not np.array_equal(scene.T_scene_file, np.eye(4)):
        root.AddTransformOp().Set(_matrix(pxr, scene.T_scene_file))
    field = pxr.UsdVol.ParticleField3DGaussianSplat.Define(stage, "/Map/Splats")
    _fill(pxr, field, placed(path, columns, HALF_TURN))
    primvars = pxr.UsdGeom.PrimvarsAPI(field)
    for name, values in sorted(extra.items()):
        _add_primvar(pxr, primvars, name, values)
    _export(pxr, stage, path)


def _fill(pxr: Any, field: Any, columns: Columns) -> None:
    """Set the attributes of the schema."""

    def vectors(values: NDArray) -> Any:
        return pxr.Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32))

    count = len(columns["positions"])
    rotations = columns["rot"] / np.linalg.norm(columns["rot"], axis=1, keepdims=True)
    # Quaternions of USD have their real part last in memory.
    quaternions = np.ascontiguousarray(np.roll(rotations, -1, axis=1), np.float32)
    harmonics = np.concatenate(
        [columns["f_dc"][:, None], columns.get("f_rest", np.zeros((count, 0, 3)))], axis=1
    )
    reach = _EXTENT * columns["scale"].max(axis=1, keepdims=True)
    low, high = columns["positions"] - reach, columns["positions"] + reach
    field.CreatePositionsAttr(vectors(columns["positions"]))
    field.CreateOrientationsAttr(pxr.Vt.QuatfArray.FromNumpy(quaternions))
    field.CreateScalesAttr(vectors(columns["scale"]))
    field.CreateOpacitiesAttr(pxr.Vt.FloatArray.FromNumpy(opacities_of(columns).astype(np.float32)))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(HARMONIC_COUNTS.index(harmonics.shape[1] - 1))
    radiance = field.CreateRadianceSphericalHarmonicsCoefficientsAttr()
    radiance.Set(vectors(harmonics.reshape(-1, 3)))
    # The schema derives it from the degree; some renderers do not.
    radiance.SetMetadata("elementSize", harmonics.shape[1])
    field.CreateExtentAttr(vectors(np.stack([low.min(axis=0), high.max(axis=0)])))
    pxr.Usd.ColorSpaceAPI.Apply(field.GetPrim()).CreateColorSpaceNameAttr(_COLOUR_SPACE)
    # For programs that show points only.
    shown = field.CreateDisplayColorPrimvar(pxr.UsdGeom.Tokens.vertex)
    shown.Set(vectors(linear_from_srgb(constant_colours(columns))))
    shown.GetAttr().SetColorSpace(_LINEAR)


def _add_primvar(pxr: Any, primvars: Any, name: str, values: NDArray) -> None:
    is_integer = np.issubdtype(values.dtype, np.integer)
    types = pxr.Sdf.ValueTypeNames
    kind = types.IntArray if is_integer else types.FloatArray
    array = pxr.Vt.IntArray if is_integer else pxr.Vt.FloatArray
    column = np.ascontiguousarray(values, np.int32 if is_integer else np.float32)
    primvar = primvars.CreatePrimvar(name, kind, pxr.UsdGeom.Tokens.vertex)
    primvar.Set(array.FromNumpy(column))


def _export(pxr: Any, stage: Any, path: Path) -> None:
    """Write a stage atomically."""
    with replacing(path) as temporary, tempfile.TemporaryDirectory() as folder, _quiet(pxr):
        try:
            if path.suffix != ".usdz":
                is_written = stage.GetRootLayer().Export(str(temporary))
            else:
                layer = Path(folder) / f"{path.stem}.usdc"
                stage.GetRootLayer().Export(str(layer))
                os.utime(layer, (_PACKAGE_DATE, _PACKAGE_DATE))
                package = pxr.UsdUtils.CreateNewUsdzPackage
                is_written = package(pxr.Sdf.AssetPath(str(layer)), str(temporary))
        except pxr.Tf.ErrorException:
            is_written = False
        if not is_written:
            raise RunFolderError(f"cannot write {path}: free space there, or allow writing")


def read_usd_splats(path: Path) -> Columns:
    """Read the splats of a stage; see `splat_columns` for the columns.

    Files of `write_usd_splats` are returned in the frame of their map, other files with the axes of
    a map (y down, z forward), in metres if the stage specifies its unit.

    Raises:
        DependencyError: usd-core is missing or too old.
        FormatError: there are no splats, or the file is damaged.
    """
    pxr = _pxr(path)
    with _quiet(pxr):
        try:
            stage = _stage(pxr, path)
            T_map_stage = _T_map_stage(pxr, stage)
            transformations = pxr.UsdGeom.XformCache(pxr.Usd.TimeCode.EarliestTime())
            everything = pxr.Usd.TraverseInstanceProxies(pxr.Usd.PrimDefaultPredicate)
            parts = []
            for prim in stage.Traverse(everything):
                if prim.GetTypeName() == _TYPE:
                    T_stage_prim = np.array(transformations.GetLocalToWorldTransform(prim)).T
                    columns = _prim_columns(pxr, path, prim)
                    parts.append(placed(path, columns, T_map_stage @ T_stage_prim))
        except DamagedError as error:
            raise FormatError(f"{path} cannot be read ({error}); write it again") from error
        except (pxr.Tf.ErrorException, OSError, RuntimeError, ValueError, TypeError) as error:
            raise FormatError(f"{path} is no USD file, or is damaged; write it again") from error
    if not parts:
        raise FormatError(f"{path} contains no splats ({_TYPE}); export them with semsplat export")
    return concatenated(parts)


def read_usd_notes(path: Path) -> SplatNotes:
    """Return the notes of a file of `write_usd_splats`; none for other files.

    Raises:
        FormatError: the class tree is damaged.
    """
    pxr = _pxr(path)
    with _quiet(pxr):
        own = _own_data(_stage(pxr, path))
        comments, text = tuple(own.get("comments", ())), own.get("taxonomy", "null")
    try:
        taxonomy = parse_json(text)
    except (ValueError, TypeError) as error:
        raise FormatError(f"{path}: the class tree is damaged; export the map again") from error
    return SplatNotes(comments, taxonomy if isinstance(taxonomy, dict) else None)


def _stage(pxr: Any, path: Path) -> Any:
    # USD opens truncated packages, and crashes while it reads damaged ones.
    if path.suffix.lower() == ".usdz":
        with Archive(path) as package:
            package.check()
    check_regular(path)
    check_layers(path)
    return pxr.Usd.Stage.Open(str(path))


def _own_data(stage: Any) -> Mapping[str, Any]:
    data = stage.GetRootLayer().customLayerData.get(_OWN)
    return data if isinstance(data, Mapping) else {}


def _T_map_stage(pxr: Any, stage: Any) -> NDArray[np.float64]:
    """The transformation [4, 4] to the map: that of our own files, or the axes and the unit."""
    own = _own_data(stage).get("T_usd_map")
    if own is not None:
        return np.asarray(np.linalg.inv(np.array(own, np.float64).T))
    T = HALF_TURN
    if pxr.UsdGeom.GetStageUpAxis(stage) == pxr.UsdGeom.Tokens.z:
        T = T @ _Y_FROM_Z_UP
    # The unit of files that do not specify it is that of the splats, not USD's centimetre.
    if pxr.UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        unit_m = pxr.UsdGeom.GetStageMetersPerUnit(stage)
        T = np.diag([unit_m, unit_m, unit_m, 1.0]) @ T
    return T


def _prim_columns(pxr: Any, path: Path, prim: Any) -> Columns:
    """The splats of a prim, in its coordinates; what is missing has the default of the schema."""
    time = pxr.Usd.TimeCode.EarliestTime()

    def values(name: str, shape: tuple[int, ...]) -> NDArray | None:
        """The first elements of an attribute in single, otherwise in half precision."""
        for attribute in (name, name + "h"):
            found = np.array(prim.GetAttribute(attribute).Get(time) or (), np.float32)
            if found.size:
                size = int(np.prod(shape))
                return found.ravel()[:size].reshape(shape) if found.size >= size else None
        return None

    count = max(len(prim.GetAttribute(n).Get(time) or ()) for n in ("positions", "positionsh"))
    positions = values("positions", (count, 3))
    if positions is None:
        raise FormatError(f"{path}: {prim.GetPath()} contains no splats; write the file again")
    degree = prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get(time)
    if degree not in range(len(HARMONIC_COUNTS)):
        raise FormatError(
            f"{path}: harmonics have degree {degree}, instead of 0 to 3; write the file again"
        )
    K = HARMONIC_COUNTS[degree] + 1
    harmonics = values("radiance:sphericalHarmonicsCoefficients", (count, K, 3))
    if harmonics is None:
        _log.warning("%s: %s has no colours; it is grey.", path, prim.GetPath())
        harmonics = np.zeros((count, 1, 3), np.float32)
    scale, rotations = values("scales", (count, 3)), values("orientations", (count, 4))
    alpha = values("opacities", (count, 1))
    columns = {
        "positions": positions,
        "scale": np.ones((count, 3), np.float32) if scale is None else scale,
        "rot": np.tile([1.0, 0, 0, 0], (count, 1)) if rotations is None else rotations,
        "opacity": logits(np.ones(count) if alpha is None else alpha[:, 0]),
        "f_dc": harmonics[:, 0],
        "f_rest": harmonics[:, 1:],
    }
    if rotations is not None:
        columns["rot"] = np.roll(rotations, 1, axis=1)
    columns |= _primvars(pxr, prim, count)
    space = pxr.Usd.ColorSpaceAPI(prim).GetColorSpaceNameAttr()
    name = space.Get() if space else None
    return in_srgb(path, columns, str(name or _COLOUR_SPACE))


def _primvars(pxr: Any, prim: Any, count: int) -> Columns:
    """Additional columns [N, 1]: primvars of numbers, one for each splat."""
    columns = {}
    for primvar in pxr.UsdGeom.PrimvarsAPI(prim).GetPrimvarsWithAuthoredValues():
        name, values = primvar.GetPrimvarName(), np.array(primvar.ComputeFlattened() or ())
        if values.shape == (count,) and values.dtype.kind in "iuf" and name not in OWN_COLUMNS:
            dtype = np.float32 if values.dtype.kind == "f" else np.int32
            columns[name] = values.astype(dtype)[:, None]
    return columns


@contextmanager
def _quiet(pxr: Any) -> Iterator[None]:
    """Collect messages of USD, which it otherwise prints."""
    delegate = pxr.UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    finally:
        del delegate


def _matrix(pxr: Any, T: NDArray[np.float64]) -> Any:
    """A matrix of USD, which multiplies rows from the left."""
    return pxr.Gf.Matrix4d(*T.T.ravel().tolist())


def _pxr(path: Path) -> Any:
    """OpenUSD, with the modules used here."""
    remedy = f"{path}: {path.suffix} needs usd-core 26.3 or newer: pip install 'semsplat[usd]'"
    try:
        import pxr
        from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdUtils, UsdVol, Vt  # noqa: F401
    except ImportError as error:
        raise DependencyError(remedy) from error
    if not hasattr(UsdVol, _TYPE):
        raise DependencyError(remedy)
    return pxr
