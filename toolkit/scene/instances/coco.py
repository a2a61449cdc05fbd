"""Masks from a file in COCO's format of instance annotations or results."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from toolkit.base.errors import DatasetError
from toolkit.base.keyframe import Keyframe
from toolkit.io.guarded.documents import read_json
from toolkit.io.guarded.images import MAX_PIXELS
from toolkit.scene.instances.masks import InstanceMasks
from toolkit.scene.instances.rle import decoded_mask
from toolkit.semantics.segmenters.image_folder import resized_labels


@dataclass(frozen=True)
class _Annotation:
    segmentation: Any
    class_name: str | None
    score: float


class CocoMasks:
    """Masks of a COCO file; where they overlap, a pixel belongs to the smallest mask.

    Images are assigned to frames by the stem of `file_name`, or by its last number.

    Args:
        path: the JSON file, with `images`, `annotations` and optional `categories`.
        stems: names of the frames' images without suffix, by frame index; None to use numbers.

    Raises:
        DatasetError: the file cannot be read, or an entry is invalid.
    """

    def __init__(self, path: Path, stems: Sequence[str] | None = None) -> None:
        self._path = path
        content = _read(path)
        try:
            _check_unique(content["images"], "image")
            _check_unique(content.get("categories", []), "category")
            names = {int(c["id"]): str(c["name"]) for c in content.get("categories", [])}
            sizes = {i["id"]: (*_size(i), str(i["file_name"])) for i in content["images"]}
            annotations = [(a["image_id"], _annotation(a, names)) for a in content["annotations"]]
            unknown = [image for image, _ in annotations if image not in sizes]
            self._frames = _frames({n: name for n, (*_, name) in sizes.items()}, stems, path)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise DatasetError(
                f"{path} is not a COCO file of instances ({error!r}); it needs images with id, "
                "height, width and file_name, and annotations with image_id and segmentation"
            ) from error
        if unknown:
            raise DatasetError(
                f"{path}: an annotation has image_id {unknown[0]}, which no image has; export the "
                "masks again"
            )
        self._sizes = {image: (height, width) for image, (height, width, _) in sizes.items()}
        self._annotations: dict[Any, list[_Annotation]] = {}
        for image, annotation in annotations:
            self._annotations.setdefault(image, []).append(annotation)

    def class_names(self) -> set[str]:
        """Return the names of the classes of all annotations."""
        found = (one.class_name for some in self._annotations.values() for one in some)
        return {name for name in found if name is not None}

    def masks(self, keyframe: Keyframe) -> InstanceMasks | None:
        """Return the masks of a keyframe's image, None without one.

        Raises:
            DatasetError: a mask cannot be decoded or has another size.
        """
        image = self._frames.get(keyframe.index)
        if image is None:
            return None
        size, found = self._sizes[image], self._annotations.get(image, [])
        ids = np.zeros(size, np.int32)
        masks = []
        for k, one in enumerate(found, start=1):
            try:
                masks.append(decoded_mask(one.segmentation, size))
            except (ValueError, OverflowError) as error:
                raise DatasetError(
                    f"{self._path}: annotation {k} of image {image}: {error}; export the masks "
                    "again"
                ) from error
        # Small masks are written last, so that they stay visible in front of large ones.
        for k in sorted(range(len(masks)), key=lambda k: -int(masks[k].sum())):
            ids[masks[k]] = k + 1
        ids = resized_labels(ids, keyframe.camera.size, self._path)
        return InstanceMasks(
            ids,
            [one.class_name for one in found],
            np.array([one.score for one in found], np.float32),
            np.zeros((len(found), 0), np.float32),
        )


def _read(path: Path) -> Mapping[str, Any]:
    try:
        content = read_json(path)
    except OSError as error:
        raise DatasetError(f"cannot read {path}: {error.strerror}; check the path") from error
    except ValueError as error:
        raise DatasetError(f"{path} is not JSON ({error}); export the masks again") from error
    if not isinstance(content, dict):
        raise DatasetError(
            f"{path} must have images, annotations and categories; results alone lack the images"
        )
    return content


def _size(image: Mapping[str, Any]) -> tuple[int, int]:
    height, width = int(image["height"]), int(image["width"])
    if height <= 0 or width <= 0 or height * width > MAX_PIXELS:
        raise ValueError(f"an image has {width}x{height} pixels")
    return height, width


def _check_unique(entries: Sequence[Mapping[str, Any]], kind: str) -> None:
    """Check that each id belongs to one entry.

    Raises:
        ValueError: one belongs to two.
    """
    seen = set()
    for entry in entries:
        if entry["id"] in seen:
            raise ValueError(f"{kind} {entry['id']} is given twice")
        seen.add(entry["id"])


def _annotation(values: Mapping[str, Any], names: Mapping[int, str]) -> _Annotation:
    score = float(values.get("score", 1.0))
    if not 0.0 <= score <= 1.0:
        raise ValueError(f"score {score} is not in 0 to 1")
    category = values.get("category_id")
    name = None if category is None else names.get(int(category))
    return _Annotation(values["segmentation"], name, score)


def _frames(names: Mapping[Any, str], stems: Sequence[str] | None, path: Path) -> dict[int, Any]:
    """The image of each frame index.

    Raises:
        DatasetError: no image belongs to a frame, or two have the same number.
    """
    if stems is not None:
        index = {stem: k for k, stem in enumerate(stems)}
        found = {index[s]: i for i, n in names.items() if (s := PurePath(n).stem) in index}
    else:
        found = {}
        for image, name in names.items():
            numbers = re.findall(r"\d+", PurePath(name).stem)
            if not numbers:
                raise DatasetError(f"{path}: {name} has no number; set --instances.pairing stem")
            if int(numbers[-1]) in found:
                raise DatasetError(f"{path}: two images have number {int(numbers[-1])}; keep one")
            found[int(numbers[-1])] = image
    if not found:
        raise DatasetError(f"{path}: no image belongs to a frame; check file_name and pairing")
    return found
