"""The scene graph while the camera moves: every keyframe extends objects and their relations."""

from __future__ import annotations

from itertools import takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.keyframe import Keyframe
from toolkit.io.arrays import arrays_below
from toolkit.scene.graph.bodies import Body
from toolkit.scene.graph.boxes import Ground
from toolkit.scene.graph.relations import RelationOptions, Role
from toolkit.scene.graph.roles import Roles
from toolkit.scene.graph.scene_relations import SceneRelations
from toolkit.scene.graph.storeys import Floors, Storeys
from toolkit.scene.growing.floors import fitted_floors, same_floors
from toolkit.scene.growing.objects import GrowingObject, thinned
from toolkit.scene.growing.rooms import ViewFan, fan_of
from toolkit.scene.growing.segments import (
    Segments,
    SegmentVoxels,
    labelled_segments,
    masked_segments,
    voxels_of_segments,
)
from toolkit.scene.growing.snapshot import Snapshot, snapshot_content
from toolkit.scene.growing.twins import MIN_SHARED, Twins
from toolkit.scene.instances.tracking import InstanceTracker, labels_of_masks
from toolkit.scene.instances.voxels import sampled, sampling_step
from toolkit.semantics.colour_names import colour_table
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.submaps.atlas import Atlas

Array = NDArray[np.float64]

# A segment belongs to an object of its class that shares this share of the smaller one's voxels;
# smaller segments start no object.
_SHARED, _MIN_VOXELS = 0.1, 4
# Edge of the voxels that represent objects, in metres.
VOXEL_M = 0.05
# Number of points that suffice for relations.
_OUTLINE_POINTS = 1500
# Factor of the edge of voxels of walls, floors and openings, which are large.
_COARSER = 2.0
# Objects that only one of this many keyframes saw are errors of labels.
_YOUNG = 8
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
    """Objects, relations and rooms of a run.

    Args:
        taxonomy: classes of the labels.
        instances: tracks objects; by default, objects are connected surfaces of one class.
    """

    def __init__(
        self,
        taxonomy: Taxonomy,
        instances: InstanceTracker | None = None,
    ) -> None:
        self._taxonomy, self._instances = taxonomy, instances
        self._leaves = {n.class_ids[0]: n for n in taxonomy.nodes if n.leaf}
        self._class_of = {n.name: class_id for class_id, n in self._leaves.items()}
        roles = Roles(taxonomy)
        self._role_of = {k: roles.of(node.path) for k, node in self._leaves.items()}
        self._floor_classes = {
            k
            for k, node in self._leaves.items()
            if self._role_of[k] == "floor" and not roles.is_ceiling(node.path)
        }
        self._colours = colour_table()
        self.objects: dict[int, GrowingObject] = {}
        self._twins = Twins(self.objects, VOXEL_M)
        contact_m = RelationOptions.contact_m + VOXEL_M
        self._live = SceneRelations(self._outline, RelationOptions(contact_m))
        self._poses: dict[int, Array] = {}
        self._fans: list[ViewFan] = []
        self._cameras: list[Array] = []  # positions of the first fans, until a pose changes
        self._seen: set[tuple[int, int]] = set()
        self._compared: dict[int, int] = {}
        self._young: dict[int, int] = {}
        self._floors: Floors | None = None
        self._floor_size, self._next = 0, 1

    def update(self, atlas: Atlas, metres_per_unit: float = 1.0) -> None:
        """Add the newest keyframes of the active submap, and follow corrections of poses.

        Args:
            atlas: all submaps.
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
            self._forget_errors()
        self._merge_instances()
        self._fit_floor()
        if self._floors is not None:
            self._live.update(self._floors, self._cameras_m(), _OBJECTS_PER_KEYFRAME)

    def finish(self, atlas: Atlas, metres_per_unit: float = 1.0) -> None:
        """Follow the last corrections, join objects of several submaps, compare all objects."""
        self._follow(atlas, metres_per_unit)
        self._merge_instances()
        if self._instances is None:
            for kept, gone in self._twins.pairs(self._poses):
                self._absorb(kept, gone)
        self._floor_size = 0
        self._fit_floor()
        self._live.all_changed()
        if self._floors is not None:
            self._live.update(self._floors, self._cameras_m())

    def content(self) -> dict[str, Any] | None:
        """The graph in node-link format; None before the floor is known."""
        snapshot = self.snapshot()
        return None if snapshot is None else snapshot_content(snapshot, self._taxonomy)

    def snapshot(self) -> Snapshot | None:
        """The scene at this time; None before the floor is known."""
        if self._floors is None:
            return None
        points = {n: self._points(n) for n in sorted(self.objects)}
        roles = {n: self._role(one) for n, one in self.objects.items()}
        return Snapshot(
            self.objects,
            points,
            roles,
            {n: self._leaves[one.class_id] for n, one in self.objects.items()},
            [n for n, one in sorted(self.objects.items()) if one.class_id in self._floor_classes],
            self._live.relations(),
            self._floors.ground,
            self._fans,
            self._poses,
        )

    def _add(self, submap: int, keyframe: Keyframe, metres_per_unit: float) -> None:
        segments = self._segments(submap, keyframe)
        if segments is None or not len(segments):
            return
        self._fans.append(fan_of(submap, keyframe, metres_per_unit))
        roles = [self._role_of.get(int(k), "object") for k in segments.class_ids]
        scale = np.array([1.0 if role == "object" else _COARSER for role in roles])
        voxels = voxels_of_segments(
            segments, keyframe, VOXEL_M * scale, metres_per_unit, self._colours
        )
        for k, found in voxels.items():
            number = int(segments.objects[k - 1])
            class_id = int(segments.class_ids[k - 1])
            number = number or self._owner(submap, class_id, found)
            if number or len(found.keys) >= _MIN_VOXELS:
                self._see(number, class_id, submap, keyframe.index, found)

    def _see(
        self, number: int, class_id: int, submap: int, index: int, found: SegmentVoxels
    ) -> None:
        """Add a segment to an object, which is new if its number is unknown or 0."""
        if number == 0:
            number, self._next = self._next, self._next + 1
        if number not in self.objects:
            self.objects[number] = GrowingObject(number, class_id, index, index)
            self._young[number] = 0
        one = self.objects[number]
        one.class_id = class_id
        is_new = submap not in one.fragments
        one.see(index, submap, found, self._confidence(number))
        if is_new and self._instances is None and len(self._poses) > 1:
            other = self._twins.of(number, submap, self._poses)
            if other:
                self._absorb(other, number)
                return
        if one.size > (1.0 + _GROWN) * self._compared.get(number, 0):
            self._compared[number] = one.size
            self._live.changed(number, self._role(one))

    def _segments(self, submap: int, keyframe: Keyframe) -> Segments | None:
        tracker = self._instances
        if tracker is None:
            return labelled_segments(keyframe)
        record = next(
            (
                r
                for r in reversed(tracker.records[-8:])
                if (r.index, r.submap) == (keyframe.index, submap)
            ),
            None,
        )
        if record is None:
            return None
        numbers = np.array([tracker.current(int(n)) if n else 0 for n in record.objects], np.int32)
        classes = np.array([self._class_of_instance(int(n)) for n in numbers], np.int32)
        if keyframe.class_ids is not None and ((classes == 0) & (numbers > 0)).any():
            # Models name classes that the labels lack, such as "couch" for "sofa".
            labels = sampled(keyframe.class_ids.numpy(), sampling_step(keyframe.camera.width))
            seen = labels_of_masks(record.ids, labels, len(numbers))
            classes = np.where(classes > 0, classes, seen)
        return masked_segments(keyframe, record, numbers, classes)

    def _class_of_instance(self, number: int) -> int:
        one = self._instances.objects.get(number) if self._instances and number else None
        name = None if one is None else one.class_name
        return 0 if name is None else self._class_of.get(name, 0)

    def _confidence(self, number: int) -> float:
        one = self._instances.objects.get(number) if self._instances else None
        return 1.0 if one is None else one.mean_score

    def _owner(self, submap: int, class_id: int, found: SegmentVoxels) -> int:
        """The object of a segment, after merging those that the segment connects; 0 for none."""
        owners = []
        for number, one in self.objects.items():
            if one.class_id != class_id or submap not in one.fragments:
                continue
            part = one.fragments[submap]
            shared = part.overlap(found.keys)
            least = _SHARED * min(len(found.keys), len(part.keys))
            if shared >= max(MIN_SHARED, least):
                owners.append(number)
        for other in owners[1:]:
            self._absorb(owners[0], other)
        return owners[0] if owners else 0

    def _absorb(self, kept: int, gone: int) -> None:
        self.objects[kept].absorb(self.objects.pop(gone))
        self._compared.pop(gone, None)
        self._live.remove(gone)
        self._live.changed(kept, self._role(self.objects[kept]))

    def _forget_errors(self) -> None:
        """Remove objects that no keyframe saw again soon."""
        for number in list(self._young):
            one = self.objects.get(number)
            if one is None or one.views > 1:
                del self._young[number]
                continue
            self._young[number] += 1
            if self._young[number] > _YOUNG:
                del self._young[number], self.objects[number]
                self._compared.pop(number, None)
                self._live.remove(number)

    def _merge_instances(self) -> None:
        """Merge what the tracker of instances has merged."""
        tracker = self._instances
        if tracker is None:
            return
        for number in [n for n in self.objects if n in tracker.merged]:
            kept = tracker.current(number)
            if kept not in self.objects:
                one = self.objects[number]
                self.objects[kept] = GrowingObject(kept, one.class_id, one.first, one.last)
            self._absorb(kept, number)

    def _follow(self, atlas: Atlas, metres_per_unit: float) -> None:
        """Take over the poses of submaps; all relations are computed again if one was corrected."""
        moved = False
        for number in range(len(atlas)):
            T = atlas.T_world_submap(number).copy()
            T[:3, 3] *= metres_per_unit
            before = self._poses.get(number)
            moved |= before is not None and bool(np.abs(T - before).max() > _MOVED)
            if before is None or not np.array_equal(T, before):
                self._cameras.clear()
            self._poses[number] = T
        if moved:
            self._twins.moved()
            self._live.all_changed()

    def _fit_floor(self) -> None:
        """Fit the floor when it has grown."""
        floors = [n for n, one in self.objects.items() if one.class_id in self._floor_classes]
        size = sum(self.objects[n].size for n in floors)
        if not self._fans or size < max(_MIN_FLOOR, _FLOOR_GROWTH * self._floor_size):
            return
        self._floor_size = size
        points = [thinned(self._points(n), _FLOOR_POINTS) for n in floors]
        found = fitted_floors(np.concatenate(points), self._cameras_m())
        if found is None:
            return
        before, self._floors = self._floors, found
        if before is None or not same_floors(before, found):
            self._live.all_changed()

    def _role(self, one: GrowingObject) -> Role:
        return self._role_of[one.class_id]

    def _points(self, number: int) -> Array:
        return self.objects[number].points_m(self._poses)

    def _outline(self, number: int) -> Array:
        """Some points of an object, which suffice for its relations."""
        return thinned(self._points(number), _OUTLINE_POINTS)

    def _cameras_m(self) -> Array:
        if not self._fans:
            return np.zeros((0, 3))
        for fan in self._fans[len(self._cameras) :]:
            self._cameras.append(fan.camera_m(self._poses))
        return np.stack(thinned(self._cameras, _MAX_CAMERAS))

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values from which `restore` continues identically."""
        arrays: dict[str, NDArray] = {}
        values: dict[str, Any] = {"objects": [], "live": self._live.values(), "next": self._next}
        for number, one in self.objects.items():
            own, described = one.state()
            arrays |= {f"objects/{number}/{name}": array for name, array in own.items()}
            values["objects"].append(described)
        for number, body in self._live.bodies.items():
            arrays[f"bodies/{number}"] = body.points
        for number, T in self._poses.items():
            arrays[f"poses/{number}"] = T
        for k, fan in enumerate(self._fans):
            arrays[f"fans/{k}"] = fan.points_m
        arrays["seen"] = np.array(sorted(self._seen), np.int64).reshape(-1, 2)
        values["fans"] = [fan.submap for fan in self._fans]
        values["poses"] = list(self._poses)
        values["young"] = list(map(list, self._young.items()))
        values["compared"] = list(map(list, self._compared.items()))
        values["floor_size"] = self._floor_size
        if self._floors is not None:
            arrays["up"] = self._floors.ground.up
            values["height_m"] = self._floors.ground.height_m
            values["storeys_m"] = list(self._floors.storeys.heights_m)
        return arrays, values

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`."""
        self.objects.clear()
        self._cameras.clear()
        self.objects |= {
            int(one["number"]): GrowingObject.from_state(
                arrays_below(arrays, f"objects/{one['number']}/"), one
            )
            for one in values["objects"]
        }
        self._poses = {int(n): np.array(arrays[f"poses/{n}"]) for n in values["poses"]}
        self._fans = [
            ViewFan(int(submap), np.array(arrays[f"fans/{k}"]))
            for k, submap in enumerate(values["fans"])
        ]
        self._seen = {(int(submap), int(index)) for submap, index in arrays["seen"]}
        self._young = {int(n): int(age) for n, age in values["young"]}
        self._compared = {int(n): int(size) for n, size in values["compared"]}
        self._floor_size, self._next = int(values["floor_size"]), int(values["next"])
        if "up" in arrays:
            ground = Ground(np.array(arrays["up"]), float(values["height_m"]))
            self._floors = Floors(ground, Storeys([float(h) for h in values["storeys_m"]]))
        bodies = {int(n): Body(np.array(arrays[f"bodies/{n}"])) for n in values["live"]["bodies"]}
        self._live.restore(values["live"], bodies)
