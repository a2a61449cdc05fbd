"""Orthographic floor plans of labelled maps, one per storey: classes from above, their areas."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.io.length_names import METRES, LengthNames
from toolkit.io.visualisation import LegendEntry, RgbImage, with_legend
from toolkit.scene.graph.boxes import Ground, floor_area_m2, oriented_box
from toolkit.scene.graph.storeys import Floors
from toolkit.scene.query import CEILING_NAMES, LabelledMap
from toolkit.semantics.palette import Palette
from toolkit.semantics.taxonomy import VOID

Array = NDArray[np.float64]

PIXEL_M = 0.02
# Discs of this many standard deviations cover a surface without gaps between Gaussians.
_DISC_SIGMAS = 1.5
_MAX_DISC = 6
_MARGIN = 12
# Height of the titles of storeys.
_TITLE = 32
# Small maps are enlarged to this width, and the map is thinned out beyond this size.
_MIN_WIDTH, _MAX_SIDE = 480, 3000
_MIN_AREA_M2 = 0.02
_BACKGROUND, _INK = (245, 246, 248), (40, 48, 58)
_ROOM, _WAY = (250, 140, 20), (215, 40, 40)
# Colours of relations; arrows lead from the source to the target, but neighbours are mutual.
_RELATIONS = {
    "on": (30, 120, 60),
    "in": (150, 40, 170),
    "above": (20, 110, 200),
    "facing": (210, 60, 40),
    "next to": (120, 124, 130),
}
# Gaussians higher than this percentile of the heights are the ceiling where it has no label.
_TOP_PERCENT = 97.0


@dataclass(frozen=True)
class ClassArea:
    """A class in a floor plan.

    Attributes:
        name: name of the class.
        area_m2: area of its vertical projection in square metres.
        colour: RGB, 0 to 255.
    """

    name: str
    area_m2: float
    colour: tuple[int, int, int]


@dataclass(frozen=True)
class FloorPlan:
    """A storey of a map seen from above.

    Attributes:
        class_ids: [H, W] int32 class of the highest Gaussian at each pixel, 0 for void, -1 where
            the map is empty. The first row has the largest y.
        pixel_m: edge of a pixel in metres.
        areas: classes with their areas, largest first.
        path: [P, 2] pixels (column, row) of the camera positions.
        T_pixels_map: [2, 4] from points of the map to pixels (column, row).
    """

    class_ids: NDArray[np.int32]
    pixel_m: float
    areas: Sequence[ClassArea]
    path: NDArray[np.float64]
    T_pixels_map: NDArray[np.float64]

    def pixels(self, points_m: Array) -> Array:
        """Return the pixels (column, row) [N, 2] of points [N, 3] of the map."""
        return points_m @ self.T_pixels_map[:, :3].T + self.T_pixels_map[:, 3]


@dataclass(frozen=True)
class PlanNode:
    """An object over a floor plan: a short text, and its place [3] in the map."""

    text: str
    centre_m: Array


@dataclass(frozen=True)
class PlanEdge:
    """A relation over a floor plan: its kind, and the places [3] of the two objects."""

    kind: str
    source_m: Array
    target_m: Array


@dataclass(frozen=True)
class PlanDrawing:
    """What is drawn over a floor plan.

    Attributes:
        rooms: label and outlines of each room: [K, 3] points of the map for each outline.
        centres_m: [R, 3] places of the labels.
        doors_m: [D, 3] places of the doors.
        way_points_m: [P, 3] a path; empty for none.
        nodes: objects of a graph.
        edges: relations between them.
    """

    rooms: Sequence[tuple[str, Sequence[Array]]]
    centres_m: Array
    doors_m: Array
    way_points_m: Array
    nodes: Sequence[PlanNode] = ()
    edges: Sequence[PlanEdge] = ()

    def by_storey(self, floors: Floors) -> list[PlanDrawing]:
        """Return what lies on each storey; relations are drawn where both objects are."""
        if len(floors.storeys) == 1:
            return [self]
        ends_m = np.array([(e.source_m, e.target_m) for e in self.edges]).reshape(-1, 3)
        nodes_m = np.array([node.centre_m for node in self.nodes]).reshape(-1, 3)
        rooms, doors, way, nodes = (
            floors.at(points_m)
            for points_m in (self.centres_m, self.doors_m, self.way_points_m, nodes_m)
        )
        ends = floors.at(ends_m).reshape(-1, 2)
        return [
            PlanDrawing(
                list(compress(self.rooms, rooms == storey)),
                self.centres_m[rooms == storey],
                self.doors_m[doors == storey],
                self.way_points_m[way == storey],
                list(compress(self.nodes, nodes == storey)),
                list(compress(self.edges, (ends == storey).all(axis=1))),
            )
            for storey in range(len(floors.storeys))
        ]


def floor_plans(
    labelled: LabelledMap, radii_m: Array, floors: Floors, cameras_m: Array, palette: Palette
) -> list[FloorPlan]:
    """Project each storey of a map onto its floor, the lowest first; ceilings are left out.

    All plans show the same area, so that a place has the same pixel on each of them.

    Args:
        labelled: N Gaussians with labels.
        radii_m: [N] their standard deviations.
        floors: planes of the floors.
        cameras_m: [P, 3] positions of the camera in the frame of the map.
        palette: colours of the classes.
    """
    ceilings = [k for k, name in enumerate(labelled.taxonomy.classes, 1) if name in CEILING_NAMES]
    shown = ~labelled.selected(labelled.known(CEILING_NAMES))
    shown &= ~np.isin(labelled.labels.label, ceilings)
    axes = oriented_box(labelled.means_m[shown], floors.ground).axes  # along the walls
    points, storey = labelled.means_m @ axes, floors.at(labelled.means_m)
    if shown.all():
        for number in np.unique(storey):
            top_m = np.percentile(points[storey == number, 2], _TOP_PERCENT)
            shown &= (storey != number) | (points[:, 2] <= top_m)
    visible = points[shown]
    side_m = float(np.ptp(visible[:, :2], axis=0).max())
    pixel_m = PIXEL_M * max(1, math.ceil(side_m / PIXEL_M / _MAX_SIDE))
    low = visible[:, :2].min(axis=0) - _MARGIN * pixel_m
    size = np.ceil((visible[:, :2].max(axis=0) - low) / pixel_m).astype(int) + _MARGIN
    T_pixels_map = np.column_stack([axes[:, :2].T, -low]) / pixel_m
    # The first row has the largest y.
    T_pixels_map[1] *= -1.0
    T_pixels_map[1, 3] += size[1]
    path = cameras_m @ T_pixels_map[:, :3].T + T_pixels_map[:, 3]
    plans, path_storey = [], floors.at(cameras_m)
    for number in range(len(floors.storeys)):
        drawn = shown & (storey == number)
        places = (points[drawn, :2] - low) / pixel_m
        sizes = np.minimum(np.rint(_DISC_SIGMAS * radii_m[drawn] / pixel_m), _MAX_DISC).astype(int)
        highest = _highest(places, sizes, points[drawn, 2], (int(size[1]), int(size[0])))
        labels = np.append(labelled.labels.label[drawn], -1)
        class_ids = labels[highest][::-1].astype(np.int32)
        areas = _areas(labelled, drawn, floors.of(number), palette)
        own = path[path_storey == number]
        plans.append(FloorPlan(class_ids, pixel_m, areas, own, T_pixels_map))
    return plans


def _highest(
    places: Array, sizes: NDArray[np.intp], height_m: Array, shape: tuple[int, int]
) -> NDArray[np.intp]:
    """Return the index of the highest disc that covers each cell [H, W], -1 for none."""
    best = np.full(shape, -1, np.intp)
    top = np.full(shape, -np.inf)
    for size in np.unique(sizes):
        index = np.flatnonzero(sizes == size)
        index = index[np.argsort(height_m[index], kind="stable")]
        columns, rows = np.floor(places[index]).astype(int).T
        span = range(-int(size), int(size) + 1)
        for i, j in ((i, j) for i in span for j in span if i * i + j * j <= size * size):
            row = np.clip(rows + i, 0, shape[0] - 1)
            column = np.clip(columns + j, 0, shape[1] - 1)
            layer = np.full(shape, -1, np.intp)
            layer[row, column] = index  # ascending heights: the highest is written last
            higher = (layer >= 0) & (height_m[layer] > top)
            best[higher] = layer[higher]
            top[higher] = height_m[layer[higher]]
    return best


def _areas(
    labelled: LabelledMap, shown: NDArray[np.bool_], ground: Ground, palette: Palette
) -> list[ClassArea]:
    label = np.where(shown, labelled.labels.label, VOID)
    areas = []
    for class_id in np.unique(label[label != VOID]).tolist():
        area_m2 = floor_area_m2(labelled.means_m[label == class_id], ground)
        r, g, b = palette.classes[class_id].tolist()
        if area_m2 >= _MIN_AREA_M2:
            areas.append(ClassArea(labelled.taxonomy.classes[class_id - 1], area_m2, (r, g, b)))
    return sorted(areas, key=lambda area: -area.area_m2)


def total_areas(plans: Sequence[FloorPlan]) -> list[ClassArea]:
    """Return the areas of classes in all storeys, largest first."""
    totals: dict[str, ClassArea] = {}
    for area in (area for plan in plans for area in plan.areas):
        known = totals.get(area.name)
        sum_m2 = area.area_m2 + (0.0 if known is None else known.area_m2)
        totals[area.name] = replace(area, area_m2=sum_m2)
    return sorted(totals.values(), key=lambda area: -area.area_m2)


def draw_floor_plans(
    plans: Sequence[FloorPlan],
    palette: Palette,
    legend: bool = True,
    names: LengthNames = METRES,
    drawings: Sequence[PlanDrawing] = (),
) -> RgbImage:
    """Return the picture of floor plans beside each other: classes, camera path and scale.

    Args:
        plans: the plan of each storey.
        legend: append the classes with their areas.
        names: of lengths.
        drawings: rooms and a path to draw over each plan; none if empty.
    """
    images = []
    for number, plan in enumerate(plans):
        image = _drawn(plan, palette, names, drawings[number] if drawings else None)
        images.append(image if len(plans) == 1 else _titled(image, f"storey {number + 1}"))
    image = np.concatenate(images, axis=1)
    if not legend:
        return image
    shown = {edge.kind for drawing in drawings for edge in drawing.edges}
    entries = [LegendEntry(kind, colour) for kind, colour in _RELATIONS.items() if kind in shown]
    entries += [
        LegendEntry(f"{a.name} {a.area_m2:.2f} {names.area}", a.colour) for a in total_areas(plans)
    ]
    return with_legend(image, entries)


def _titled(image: RgbImage, title: str) -> RgbImage:
    band = np.full((_TITLE, image.shape[1], 3), _BACKGROUND, np.uint8)
    _write(band, title, (_MARGIN, _TITLE - 8))
    return np.concatenate([band, image])


def _drawn(
    plan: FloorPlan, palette: Palette, names: LengthNames, drawing: PlanDrawing | None
) -> RgbImage:
    """Return the picture of one storey."""
    colours = np.concatenate([palette.classes, np.array([_BACKGROUND], np.uint8)])
    colours[VOID] = (150, 156, 164)
    image = colours[plan.class_ids]  # -1 is the background, the last row
    factor = max(1, math.ceil(_MIN_WIDTH / image.shape[1]))
    image = np.ascontiguousarray(image.repeat(factor, axis=0).repeat(factor, axis=1))
    if len(plan.path) > 1:
        points = np.rint(factor * plan.path).astype(np.int32)
        cv2.polylines(image, [points], False, (255, 255, 255), 3, cv2.LINE_AA)
        cv2.polylines(image, [points], False, _INK, 1, cv2.LINE_AA)
    if drawing is not None:
        _draw_rooms(image, plan, factor, drawing)
        _draw_graph(image, plan, factor, drawing)
    _draw_scale(image, factor / plan.pixel_m, names)
    return image


def _draw_scale(image: RgbImage, pixels_per_m: float, names: LengthNames) -> None:
    """Draw a bar of one metre or unit in the lower left corner."""
    length, bottom = round(pixels_per_m), image.shape[0] - 8
    cv2.line(image, (8, bottom), (8 + length, bottom), _INK, 2)
    text = f"1 {names.length.removesuffix('s')}"
    cv2.putText(image, text, (12, bottom - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.45, _INK, 1, cv2.LINE_AA)


def _write(image: RgbImage, text: str, place: tuple[int, int]) -> None:
    """Write a text with a white outline; `place` is its lower left corner."""
    for colour, width in (((255, 255, 255), 6), (_INK, 2)):
        cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.7, colour, width, cv2.LINE_AA)


def _draw_rooms(image: RgbImage, plan: FloorPlan, factor: int, drawing: PlanDrawing) -> None:
    """Draw outlines, names and doors of rooms, and a path."""
    for (name, outlines), centre_m in zip(drawing.rooms, drawing.centres_m, strict=True):
        for outline_m in outlines:
            points = np.rint(factor * plan.pixels(outline_m)).astype(np.int32)
            cv2.polylines(image, [points], True, _ROOM, 2, cv2.LINE_AA)
        x, y = np.rint(factor * plan.pixels(centre_m[None])[0]).astype(int).tolist()
        _write(image, name, (x - 6 * len(name), y))
    for door in np.rint(factor * plan.pixels(drawing.doors_m)).astype(int).tolist():
        cv2.circle(image, door, 5, _ROOM, -1, cv2.LINE_AA)
    if len(drawing.way_points_m) > 1:
        points = np.rint(factor * plan.pixels(drawing.way_points_m)).astype(np.int32)
        cv2.polylines(image, [points], False, (255, 255, 255), 6, cv2.LINE_AA)
        cv2.polylines(image, [points], False, _WAY, 3, cv2.LINE_AA)
        for end in (points[0].tolist(), points[-1].tolist()):
            cv2.circle(image, end, 5, _WAY, -1, cv2.LINE_AA)


def _draw_graph(image: RgbImage, plan: FloorPlan, factor: int, drawing: PlanDrawing) -> None:
    """Draw the relations of objects as arrows, and the objects as discs with their texts."""

    def pixel(place_m: Array) -> tuple[int, int]:
        x, y = np.rint(factor * plan.pixels(place_m[None])[0]).astype(int).tolist()
        return x, y

    for edge in sorted(drawing.edges, key=lambda e: e.kind != "next to"):
        start, end = pixel(edge.source_m), pixel(edge.target_m)
        colour = _RELATIONS.get(edge.kind, _INK)
        if edge.kind == "next to":
            cv2.line(image, start, end, colour, 1, cv2.LINE_AA)
        else:
            length = max(float(np.hypot(end[0] - start[0], end[1] - start[1])), 1.0)
            cv2.arrowedLine(image, start, end, colour, 2, cv2.LINE_AA, tipLength=12.0 / length)
    for node in drawing.nodes:
        centre = pixel(node.centre_m)
        cv2.circle(image, centre, 10, (255, 255, 255), -1, cv2.LINE_AA)
        cv2.circle(image, centre, 10, _INK, 1, cv2.LINE_AA)
        place = (centre[0] - 4 * len(node.text), centre[1] + 4)
        cv2.putText(image, node.text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.38, _INK, 1, cv2.LINE_AA)
