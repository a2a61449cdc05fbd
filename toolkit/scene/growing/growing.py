"""Scene graph of a run while it maps: tracked objects, their relations, rooms and storeys.

Every keyframe adds to the objects of a tracker. Objects that are new or have grown wait to be
compared with those around them; a keyframe compares a bounded number of them, so that its time does
not depend on the length of the run. The end of the run compares all.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.thinning import thinned
from toolkit.base.keyframe import Keyframe
from toolkit.io.arrays import arrays_below
from toolkit.scene.graph.bodies import Body
from toolkit.scene.graph.boxes import Ground
from toolkit.scene.graph.relations import RelationOptions, Role
from toolkit.scene.graph.roles import Roles
from toolkit.scene.graph.scene_relations import SceneRelations
from toolkit.scene.graph.storeys import Floors, Storeys
from toolkit.scene.growing.counts import PixelCounts
from toolkit.scene.growing.floors import fitted_floors, same_floors
from toolkit.scene.growing.rooms import ViewFan, fan_of
from toolkit.scene.growing.snapshot import SeenObject, Snapshot
from toolkit.scene.growing.surfaces import Surfaces
from toolkit.scene.growing.twins import Twins
from toolkit.scene.instances.objects import class_name_of
from toolkit.scene.instances.tracking import InstanceTracker
from toolkit.scene.instances.voxels import sampled, sampling_step
from toolkit.semantics.colour_names import COLOUR_NAMES, colour_table
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.submaps.atlas import Atlas

Array = NDArray[np.float64]

# Objects of fewer voxels, or of a single mask, are noise.
_MIN_VOXELS, _MIN_VIEWS = 6, 2
# Number of points that suffice for relations.
_OUTLINE_POINTS = 1500
# Number of objects whose relations are computed per keyframe; others wait.
_OBJECTS_PER_KEYFRAME = 2
# An object that has grown by this share is compared again.
_GROWN = 0.25
# The floor is fitted again when its number of voxels has grown by this factor.
_FLOOR_GROWTH, _FLOOR_POINTS, _MIN_FLOOR = 1.5, 400, 40
# Number of cameras that determine which side of the floor is up, and which one panels face.
_MAX_CAMERAS = 100
# Poses of submaps that differ by less have not been corrected.
_MOVED = 1e-6


class GrowingScene:
    """Relations and rooms of the objects of a run.

    Args:
        taxonomy: classes of the labels.
        tracker: follows the objects.
        connected: objects of one class that touch are one, as in maps without instances.
    """

    def __init__(
        self, taxonomy: Taxonomy, tracker: InstanceTracker, connected: bool = False
    ) -> None:
        self._taxonomy, self._tracker, self._connected = taxonomy, tracker, connected
        leaves = {k: taxonomy.leaf(k) for k in range(1, len(taxonomy) + 1)}
        self._class_of = {leaf.name: class_id for class_id, leaf in leaves.items()}
        roles = Roles(taxonomy)
        self._role_of = {k: roles.of(leaf.path) for k, leaf in leaves.items()}
        self._floor_classes = {k for k, leaf in leaves.items() if roles.kind(leaf.path) == "floor"}
        self._colour_table = colour_table()
        self._colours = PixelCounts(len(COLOUR_NAMES))
        self._labels = PixelCounts(len(taxonomy) + 1)
        self._surfaces = Surfaces(tracker)
        self._twins = Twins(self._surfaces)
        # Surfaces are known up to the edge of a voxel.
        contact_m = RelationOptions.contact_m + tracker.options.voxel_m
        self._relations = SceneRelations(self._outline, RelationOptions(contact_m))
        self._fans: list[ViewFan] = []
        self._cameras: list[Array] = []  # positions of the first fans, until a pose changes
        self._seen: set[tuple[int, int]] = set()
        self._classes: dict[int, int] = {}  # of the shown objects
        self._known: dict[int, tuple[tuple[int, ...], int]] = {}  # of all, by their masks
        self._compared: dict[int, int] = {}
        self._floors: Floors | None = None
        self._floor_size = 0

    def update(self, atlas: Atlas, metres_per_unit: float = 1.0) -> None:
        """Add the newest keyframes of the active submap, and follow corrections of poses.

        Args:
            atlas: all submaps; the tracker has seen its keyframes.
            metres_per_unit: length of the unit of the atlas; the scene is in metres.
        """
        number, keyframes = atlas.active, atlas.keyframes
        new = list(takewhile(lambda k: (number, k.index) not in self._seen, reversed(keyframes)))
        if not new:
            return
        self._follow(atlas, metres_per_unit)
        for keyframe in reversed(new):
            self._seen.add((number, keyframe.index))
            self._add(number, keyframe, metres_per_unit)
        self._surfaces.read(metres_per_unit, number)
        self._take_over()
        self._fit_floor()
        if self._floors is not None:
            self._relations.update(self._floors, self._cameras_m(), _OBJECTS_PER_KEYFRAME)

    def finish(self, atlas: Atlas, metres_per_unit: float = 1.0) -> None:
        """Follow the last corrections, join objects of several submaps, compare all objects."""
        self._follow(atlas, metres_per_unit)
        if not self._connected:
            self._surfaces.twins.clear()  # the tracker has joined its objects
        self._surfaces.read(metres_per_unit)
        self._take_over()
        if self._connected:
            self._join_all()
        self._floor_size = 0
        self._fit_floor()
        self._relations.all_changed()
        if self._floors is not None:
            self._relations.update(self._floors, self._cameras_m())

    def snapshot(self) -> Snapshot | None:
        """The scene at this time; None before the floor is known."""
        if self._floors is None:
            return None
        seen = self._views()
        objects = [
            SeenObject(
                number,
                class_id,
                COLOUR_NAMES[int(self._colours.of(self._surfaces.parts[number]).argmax())],
                round(self._confidence(number), 4),
                *seen[number],
            )
            for number, class_id in sorted(self._classes.items())
        ]
        points_m = self._surfaces.points_m(self._classes)
        fans_m = [fan.world_m(self._surfaces.poses) for fan in self._fans]
        return Snapshot(
            objects,
            {number: own.astype(np.float32) for number, own in points_m.items()},
            self._relations.relations(),
            self._floors.ground,
            np.array(fans_m, np.float32),
        )

    def content(self) -> dict[str, Any] | None:
        """The graph in node-link format; None before the floor is known."""
        snapshot = self.snapshot()
        return None if snapshot is None else snapshot.content(self._taxonomy)

    def _add(self, submap: int, keyframe: Keyframe, metres_per_unit: float) -> None:
        record = self._tracker.record_of(submap, keyframe.index)
        if record is None:
            return
        self._fans.append(fan_of(submap, keyframe, metres_per_unit))
        step = sampling_step(keyframe.camera.width)
        rgb = sampled(keyframe.rgb.numpy(), step) >> 3
        self._colours.add(record, self._colour_table[rgb[0], rgb[1], rgb[2]])
        if keyframe.class_ids is not None:
            self._labels.add(record, sampled(keyframe.class_ids.numpy(), step))

    def _take_over(self) -> None:
        """Take over the objects of the tracker; those that are new or have grown are compared."""
        surfaces, known = self._surfaces, self._classes
        surfaces.group()
        self._classes = self._shown()
        for number in [n for n in known if n not in self._classes]:
            self._relations.remove(number)
            self._compared.pop(number, None)
        twins = {n: self._twin(n, known) for n in self._classes if n not in known}
        twins = {number: other for number, other in twins.items() if other}
        if twins:
            surfaces.twins |= twins
            surfaces.group()
            self._classes = {n: k for n, k in self._classes.items() if n not in twins}
        for number in self._classes:
            size = int(surfaces.sizes[number])
            if size > (1.0 + _GROWN) * self._compared.get(number, 0):
                self._compared[number] = size
                self._relations.changed(number, self._role(number))

    def _shown(self) -> dict[int, int]:
        """The class of each object that is not noise."""
        surfaces = self._surfaces
        sizes = surfaces.sizes.tolist()
        large = [
            number
            for number in surfaces.parts
            if sizes[number] >= _MIN_VOXELS and surfaces.views(number) >= _MIN_VIEWS
        ]
        classes = {number: self._class(number) for number in large}
        return {number: class_id for number, class_id in classes.items() if class_id}

    def _class(self, number: int) -> int:
        """The class of an object; it changes with its masks alone."""
        masks = (self._surfaces.views(number), *self._surfaces.parts[number])
        known = self._known.get(number)
        if known is None or known[0] != masks:
            known = self._known[number] = masks, self._voted_class(masks[1:])
        return known[1]

    def _voted_class(self, parts: Sequence[int]) -> int:
        """The class of an object: that of its masks if the taxonomy has it, else of the labels."""
        name = class_name_of(self._tracker.objects[part] for part in parts)
        if name in self._class_of:
            return self._class_of[name]
        counts = self._labels.of(parts)
        counts[0] = 0
        return int(counts.argmax())

    def _twin(self, number: int, among: Iterable[int], touching: bool = False) -> int:
        """The object of the same class that is the same one; 0 for none."""
        class_id = self._classes[number]
        others = [n for n in among if self._classes.get(n) == class_id]
        return self._twins.of(number, others, touching)

    def _join_all(self) -> None:
        """Join objects of one class whose surfaces coincide or touch."""
        for number in sorted(self._classes):
            while number in self._classes:
                other = self._twin(number, self._classes, touching=True)
                if not other:
                    break
                kept, gone = sorted((number, other))
                self._surfaces.twins[gone] = kept
                self._take_over()

    def _views(self) -> dict[int, tuple[int, int, int]]:
        """The first and the last keyframe with a mask of each object, and their number."""
        records = self._tracker.records
        index = np.repeat([r.index for r in records], [len(r.objects) for r in records])
        objects = np.concatenate([np.zeros(0, np.int32), *(r.objects for r in records)])
        owner = self._surfaces.table[objects]
        pairs = np.unique(np.stack([owner, index.astype(np.int32)]), axis=1)
        starts = np.flatnonzero(np.diff(pairs[0], prepend=-1))
        ends = [*starts[1:], pairs.shape[1]]
        return {
            int(pairs[0, a]): (int(pairs[1, a]), int(pairs[1, b - 1]), int(b - a))
            for a, b in zip(starts, ends, strict=True)
        }

    def _confidence(self, number: int) -> float:
        parts = [self._tracker.objects[part] for part in self._surfaces.parts[number]]
        return sum(part.score for part in parts) / max(sum(part.views for part in parts), 1)

    def _follow(self, atlas: Atlas, metres_per_unit: float) -> None:
        """Take over the poses of submaps; all relations are computed again if one was corrected."""
        moved, poses = False, self._surfaces.poses
        for number in range(len(atlas)):
            T = atlas.T_world_submap(number).copy()
            T[:3, 3] *= metres_per_unit
            before = poses.get(number)
            moved |= before is not None and bool(np.abs(T - before).max() > _MOVED)
            if before is None or not np.array_equal(T, before):
                self._cameras.clear()
            poses[number] = T
        if moved:
            self._twins.moved()
            self._relations.all_changed()

    def _fit_floor(self) -> None:
        """Fit the floor when it has grown."""
        floors = [n for n, class_id in self._classes.items() if class_id in self._floor_classes]
        size = int(self._surfaces.sizes[floors].sum())
        if not self._fans or size < max(_MIN_FLOOR, _FLOOR_GROWTH * self._floor_size):
            return
        self._floor_size = size
        points_m = self._surfaces.points_m(floors).values()
        points = np.concatenate([thinned(own, _FLOOR_POINTS) for own in points_m])
        found = fitted_floors(points, self._cameras_m())
        if found is None:
            return
        before, self._floors = self._floors, found
        if before is None or not same_floors(before, found):
            self._relations.all_changed()

    def _role(self, number: int) -> Role:
        return self._role_of[self._classes[number]]

    def _outline(self, number: int) -> Array:
        """Some points of an object, which suffice for its relations."""
        return thinned(self._surfaces.points_m([number])[number], _OUTLINE_POINTS)

    def _cameras_m(self) -> Array:
        if not self._fans:
            return np.zeros((0, 3))
        for fan in self._fans[len(self._cameras) :]:
            self._cameras.append(fan.camera_m(self._surfaces.poses))
        return np.stack(thinned(self._cameras, _MAX_CAMERAS))

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values from which `restore` continues identically.

        The tracker is not part of it.
        """
        arrays = {f"colours/{name}": a for name, a in self._colours.state().items()}
        arrays |= {f"labels/{name}": a for name, a in self._labels.state().items()}
        for number, body in self._relations.bodies.items():
            arrays[f"bodies/{number}"] = body.points
        for number, T in self._surfaces.poses.items():
            arrays[f"poses/{number}"] = T
        for k, fan in enumerate(self._fans):
            arrays[f"fans/{k}"] = fan.points_m
        arrays["seen"] = np.array(sorted(self._seen), np.int64).reshape(-1, 2)
        values: dict[str, Any] = {
            "relations": self._relations.values(),
            "fans": [fan.submap for fan in self._fans],
            "poses": list(self._surfaces.poses),
            "twins": list(map(list, self._surfaces.twins.items())),
            "classes": list(map(list, self._classes.items())),
            "compared": list(map(list, self._compared.items())),
            "floor_size": self._floor_size,
            "metres_per_unit": self._surfaces.metres_per_unit,
        }
        if self._floors is not None:
            arrays["up"] = self._floors.ground.up
            values["height_m"] = self._floors.ground.height_m
            values["storeys_m"] = list(self._floors.storeys.heights_m)
        return arrays, values

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`, after that of the tracker."""
        self._cameras.clear()
        self._colours.restore(arrays_below(arrays, "colours/"))
        self._labels.restore(arrays_below(arrays, "labels/"))
        self._surfaces.poses |= {int(n): np.array(arrays[f"poses/{n}"]) for n in values["poses"]}
        self._surfaces.twins |= _pairs(values["twins"])
        self._surfaces.read(float(values["metres_per_unit"]))
        self._surfaces.group()
        self._fans = [
            ViewFan(int(submap), np.array(arrays[f"fans/{k}"]))
            for k, submap in enumerate(values["fans"])
        ]
        self._seen = {(int(submap), int(index)) for submap, index in arrays["seen"]}
        self._classes, self._compared = _pairs(values["classes"]), _pairs(values["compared"])
        self._floor_size = int(values["floor_size"])
        if "up" in arrays:
            ground = Ground(np.array(arrays["up"]), float(values["height_m"]))
            self._floors = Floors(ground, Storeys([float(h) for h in values["storeys_m"]]))
        relations = values["relations"]
        bodies = {int(n): Body(np.array(arrays[f"bodies/{n}"])) for n in relations["bodies"]}
        self._relations.restore(relations, bodies)


def _pairs(rows: list[list[int]]) -> dict[int, int]:
    return {int(a): int(b) for a, b in rows}
