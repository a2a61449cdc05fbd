"""Colours of the Gaussians in the viewers, as the offline page computes them."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.viewer.scene import INFERRED_RGB, MEASURED_RGB, UNKNOWN_RGB, ViewerScene

COLOUR, CLASSES, SUBMAPS, CONFIDENCE, SOURCE = (
    "colour",
    "classes",
    "submaps",
    "confidence",
    "source",
)
# Opacity and brightness of Gaussians that are not highlighted.
_DIMMED_OPACITY, _DIMMED_BRIGHTNESS = 0.07, 0.6
_CONFIDENCE_STOPS = np.array(
    [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], float
)
_LUMA = np.array([0.299, 0.587, 0.114])
_GOLDEN = 0.61803399


@dataclass(frozen=True)
class Appearance:
    """Colours and opacities of the Gaussians.

    Attributes:
        rgb: [N, 3] uint8.
        opacities: [N] float32 in [0, 1].
    """

    rgb: NDArray[np.uint8]
    opacities: NDArray[np.float32]


@dataclass(frozen=True)
class LegendRow:
    """An entry of the legend: its name, colour, and fraction of the Gaussians."""

    name: str
    rgb: tuple[int, int, int]
    fraction: float


def colour_modes(scene: ViewerScene) -> list[str]:
    """Return the kinds of colours that a scene has."""
    modes = [COLOUR]
    if scene.tree is not None and scene.splats.levels is not None:
        modes.append(CLASSES)
    if len(scene.splats.submap_numbers) > 1:
        modes.append(SUBMAPS)
    if scene.splats.confidence is not None:
        modes.append(CONFIDENCE)
    if scene.splats.inferred is not None:
        modes.append(SOURCE)
    return modes


def appearance(
    scene: ViewerScene, mode: str, level: int, highlighted: list[int] | None = None
) -> Appearance:
    """Return the colours of all Gaussians.

    Args:
        scene: the scene.
        mode: one of `colour_modes`.
        level: level of the class tree, for classes.
        highlighted: nodes of the tree whose Gaussians are highlighted; None for no highlighting.
    """
    splats = scene.splats
    brightness = splats.rgb @ _LUMA / 255.0
    rgb = _plain_colours(scene, mode, level)
    # Some of the observed brightness remains, or objects of one class have no visible shape.
    shade = np.ones(len(splats)) if mode == COLOUR else 0.65 + 0.45 * brightness
    opacities = splats.opacities.copy()
    if highlighted is not None and scene.tree is not None and splats.levels is not None:
        match = np.zeros(len(splats), bool)
        for node in highlighted:
            members = splats.levels[:, scene.tree.nodes[node].level] == node
            rgb[members] = scene.tree.nodes[node].rgb
            match |= members
        rgb[~match] = 255.0 * brightness[~match, None]
        shade[~match] = _DIMMED_BRIGHTNESS
        opacities[~match] *= _DIMMED_OPACITY
    shaded = np.clip(rgb * shade[:, None], 0.0, 255.0)
    return Appearance(shaded.astype(np.uint8), opacities)


def legend(scene: ViewerScene, mode: str, level: int) -> list[LegendRow]:
    """Return the entries of the legend, most frequent first; none for continuous colours."""
    splats = scene.splats
    if mode == CLASSES and scene.tree is not None and splats.levels is not None:
        names = {i: node.path[-1] for i, node in enumerate(scene.tree.nodes)} | {-1: "no class"}
        colours = {i: node.rgb for i, node in enumerate(scene.tree.nodes)} | {-1: UNKNOWN_RGB}
        keys = splats.levels[:, level]
    elif mode == SUBMAPS and splats.submap is not None:
        keys = splats.submap
        names = {n: f"submap {n}" for n in splats.submap_numbers}
        colours = {n: submap_rgb(n) for n in splats.submap_numbers}
    elif mode == SOURCE and splats.inferred is not None:
        keys = splats.inferred.astype(np.int32)
        names = {0: "measured", 1: "inferred (depth prior)"}
        colours = {0: MEASURED_RGB, 1: INFERRED_RGB}
    else:
        return []
    found, counts = np.unique(keys, return_counts=True)
    order = np.argsort(-counts, kind="stable") if mode != SUBMAPS else range(len(found))
    return [
        LegendRow(names[int(found[i])], colours[int(found[i])], counts[i] / len(splats))
        for i in order
    ]


def submap_rgb(number: int) -> tuple[int, int, int]:
    """Return a well separated colour: the hue advances by the golden angle."""
    red, green, blue = colorsys.hls_to_rgb((number * _GOLDEN + 0.58) % 1.0, 0.58, 0.76)
    return round(255 * red), round(255 * green), round(255 * blue)


def _plain_colours(scene: ViewerScene, mode: str, level: int) -> NDArray[np.float64]:
    """Return the colours [N, 3] without shading and highlighting, 0 to 255."""
    splats = scene.splats
    if mode == CLASSES and scene.tree is not None and splats.levels is not None:
        # The last row, index -1, is the colour of unknown classes.
        table = np.array([*(node.rgb for node in scene.tree.nodes), UNKNOWN_RGB], float)
        return table[splats.levels[:, level]]
    if mode == SUBMAPS and splats.submap is not None:
        numbers, places = np.unique(splats.submap, return_inverse=True)
        return np.array([submap_rgb(int(n)) for n in numbers], float)[places]
    if mode == CONFIDENCE and splats.confidence is not None:
        stops = np.linspace(0.0, 1.0, len(_CONFIDENCE_STOPS))
        channels = [np.interp(splats.confidence, stops, c) for c in _CONFIDENCE_STOPS.T]
        return np.stack(channels, axis=1)
    if mode == SOURCE and splats.inferred is not None:
        return np.array([MEASURED_RGB, INFERRED_RGB], float)[splats.inferred.astype(int)]
    return splats.rgb.astype(float)
