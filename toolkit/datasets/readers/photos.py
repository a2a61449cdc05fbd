"""A folder of photos or frames, or a text file that lists them: colour without depth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toolkit.base.errors import DatasetError
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.base import FrameFiles, Recording
from toolkit.datasets.orientation import oriented_camera, oriented_distortion, swaps_sides
from toolkit.datasets.pairing import listed, natural_key
from toolkit.datasets.readers.folder import DEFAULT_FPS, Intrinsics, read_intrinsics
from toolkit.datasets.readers.video import FOCAL_SIGMA, camera_with_focal, typical_camera
from toolkit.io.exif import PhotoInfo, read_photo_info
from toolkit.io.trajectories import text_lines
from toolkit.io.user_files import visible

INTRINSICS = "intrinsics.yaml"
_SUFFIXES = (".jpg", ".jpeg", ".png")
_OTHER_SUFFIXES = (".heic", ".heif", ".webp", ".tif", ".tiff", ".dng", ".bmp")
# Recordings have one camera; zoom changes the focal length by more.
_MAX_FOCAL_DEVIATION = 0.02


@dataclass(frozen=True)
class _Lens:
    """Intrinsics of the images as shown; `sigma` as `Recording.focal_sigma`."""

    camera: Camera
    distortion: tuple[float, ...] | None = None
    fisheye: bool = False
    calibrated: bool = False
    sigma: float | None = None
    note: str = ""


def describe(path: Path) -> Recording:
    """Describe the JPEG and PNG files of a folder or those listed in a text file.

    Files of a folder are sorted by name, numbers within names by value; a list has one path per
    line, relative to its folder, and gives the order. The timestamp of image i is i / fps. Images
    are turned by EXIF's orientation. `intrinsics.yaml` in the same folder has the keys of the
    `folder` layout, without `depth_scale`; its size may be that of the stored or the shown images.
    Without it, the focal length is that of EXIF or a typical one, and is to be estimated.

    Raises:
        DatasetError: there are no images, or they differ in size or focal length, or the intrinsics
            are malformed or for another size.
    """
    if not path.exists():
        raise DatasetError(f"{path} does not exist; check the path")
    folder, paths = _listed_in(path) if path.is_file() else _inside(path)
    infos = [read_photo_info(file) for file in paths]
    shown = [_shown_size(info) for info in infos]
    if len(set(shown)) > 1:
        common = max(sorted(set(shown)), key=shown.count)
        odd = [file.name for file, size in zip(paths, shown, strict=True) if size != common]
        raise DatasetError(
            f"images in {path} have different sizes: {len(odd)} are not {common[0]}x{common[1]} "
            f"({listed(odd)}); use images of one camera in one orientation"
        )
    intrinsics = None
    if (folder / INTRINSICS).exists():
        intrinsics = read_intrinsics(folder / INTRINSICS, has_depth=False)
    lens = _given(folder / INTRINSICS, intrinsics, infos) if intrinsics else _stated(path, infos)
    fps = intrinsics.fps if intrinsics else DEFAULT_FPS
    return Recording(
        name=path.resolve().stem,
        camera=lens.camera,
        files=tuple(
            FrameFiles(i / fps, file, None, orientation=info.orientation)
            for i, (file, info) in enumerate(zip(paths, infos, strict=True))
        ),
        depth_scale=1.0,
        distortion=lens.distortion,
        fisheye=lens.fisheye,
        notes=(lens.note,) if lens.note else (),
        calibrated=lens.calibrated,
        focal_sigma=lens.sigma,
    )


def _inside(folder: Path) -> tuple[Path, list[Path]]:
    """The folder with images, `folder` or its only child that has any, and the images in order."""
    for candidates in ([folder], [child for child in visible(folder) if child.is_dir()]):
        found = {place: _images_in(place) for place in candidates}
        filled = [place for place, images in found.items() if images]
        if len(filled) == 1:
            return filled[0], found[filled[0]]
        if filled:
            raise DatasetError(
                f"{folder} contains {len(filled)} folders with images "
                f"({listed([place.name for place in filled])}); specify the path of one"
            )
    other = sorted({f.suffix for f in visible(folder) if f.suffix.lower() in _OTHER_SUFFIXES})
    reason = f"; convert its {', '.join(other)} files to JPEG" if other else "; check the path"
    raise DatasetError(f"{folder} contains no JPEG or PNG images{reason}")


def _images_in(folder: Path) -> list[Path]:
    files = [file for file in visible(folder) if file.suffix.lower() in _SUFFIXES]
    return sorted(files, key=lambda file: natural_key(file.name))


def _listed_in(path: Path) -> tuple[Path, list[Path]]:
    """The folder of a list, and the images in its order."""
    if path.suffix.lower() in (*_SUFFIXES, *_OTHER_SUFFIXES):
        raise DatasetError(f"{path} is one image; specify its folder")
    paths = []
    for number, line in text_lines(path):
        file = path.parent / line.strip().replace("\\", "/")
        if not file.is_file():
            raise DatasetError(f"{path}, line {number}: there is no file {file}; correct the line")
        paths.append(file)
    if not paths:
        raise DatasetError(f"{path} lists no images; write one path per line")
    return path.parent, paths


def _shown_size(info: PhotoInfo) -> tuple[int, int]:
    width, height = info.size
    return (height, width) if swaps_sides(info.orientation) else (width, height)


def _given(file: Path, intrinsics: Intrinsics, infos: list[PhotoInfo]) -> _Lens:
    """Intrinsics of a file, turned with the images if they are for the stored pixels."""
    camera, distortion = intrinsics.camera, intrinsics.distortion
    info = infos[0]
    if camera.size != _shown_size(info):
        width, height = _shown_size(info)
        if camera.size != info.size:
            raise DatasetError(
                f"{file} is for {camera.width}x{camera.height} pixels but the images have "
                f"{width}x{height}; correct the file"
            )
        camera = oriented_camera(camera, info.orientation)
        if distortion and not intrinsics.fisheye:
            distortion = oriented_distortion(distortion, info.orientation)
    return _Lens(camera, distortion, intrinsics.fisheye, calibrated=True)


def _stated(path: Path, infos: list[PhotoInfo]) -> _Lens:
    """Intrinsics from EXIF, or typical ones."""
    width, height = _shown_size(infos[0])
    focals = [info.focal_px for info in infos if info.focal_px is not None]
    if not focals:
        note = f"no {INTRINSICS} and no focal length in EXIF; the focal length is estimated"
        return _Lens(typical_camera(width, height), note=note)
    focal = float(np.median(focals))
    deviation = float(np.abs(np.array(focals) / focal - 1.0).max())
    if deviation > _MAX_FOCAL_DEVIATION:
        raise DatasetError(
            f"focal lengths of the images in {path} differ by {100 * deviation:.0f} % from their "
            f"median; use images of one camera and zoom"
        )
    note = f"the focal length of EXIF, {focal:.0f} pixels, is the initial value of the estimate"
    return _Lens(camera_with_focal(width, height, focal), sigma=FOCAL_SIGMA, note=note)
