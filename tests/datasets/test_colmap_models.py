"""Reconstructions of COLMAP, as text and in binary."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_frames import HEIGHT, WIDTH, frame_rgb, pose

from toolkit.base.errors import DatasetError, FormatError
from toolkit.base.geometry import se3
from toolkit.datasets.registry import open_dataset
from toolkit.io import images
from toolkit.io.colmap import read_cameras

NAMES = ["IMG_2.png", "IMG_10.png", "IMG 11.png"]
PINHOLE = f"1 PINHOLE {WIDTH} {HEIGHT} 30 31 16 12"


def image_line(index: int, name: str, camera: int = 1) -> str:
    T_camera_world = np.linalg.inv(pose(index))
    x, y, z, w = se3.quaternion_xyzw(T_camera_world[:3, :3])
    values = [index + 1, w, x, y, z, *T_camera_world[:3, 3], camera, name]
    return " ".join(map(str, values))


def write(
    folder: Path, cameras: str = PINHOLE, lines: list[str] | None = None, model: str = "sparse/0"
) -> Path:
    project = folder / "project"
    (project / "images").mkdir(parents=True)
    (project / model).mkdir(parents=True, exist_ok=True)
    for index, name in enumerate(NAMES):
        images.write_rgb(project / "images" / name, frame_rgb(index))
    lines = lines or [image_line(index, name) for index, name in enumerate(NAMES)]
    # The second image has points, the others have empty lines.
    points = ["", "1.5 2.5 -1 3.5 4.5 7", ""]
    text = "\n".join(f"{line}\n{p}" for line, p in zip(lines, points, strict=False))
    (project / model / "images.txt").write_text(f"# Image list\n{text}\n")
    (project / model / "cameras.txt").write_text(f"# Camera list\n{cameras}\n")
    return project


def opened(path: Path):
    return open_dataset("colmap", path, needs_depth=False)


@pytest.mark.parametrize("model", ["sparse/0", "sparse", ""])
def test_images_poses_and_camera_are_those_written(tmp_path, model):
    dataset = opened(write(tmp_path, model=model))
    assert [file.rgb.name for file in dataset.recording.files] == [NAMES[2], NAMES[0], NAMES[1]]
    camera = dataset.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (30, 31, 15.5, 11.5)
    for i, written in enumerate((2, 0, 1)):
        np.testing.assert_allclose(dataset[i].rgb, frame_rgb(written), atol=0.01)
        T = dataset.ground_truth.T_world_camera[i]
        np.testing.assert_allclose(T, pose(written), atol=1e-9)


def test_the_folder_of_the_model_is_accepted(tmp_path):
    assert len(opened(write(tmp_path) / "sparse/0")) == 3


@pytest.mark.parametrize(
    ("model", "parameters", "distortion"),
    [
        ("SIMPLE_PINHOLE", [30, 16, 12], None),
        ("SIMPLE_RADIAL", [30, 16, 12, 0.1], (0.1, 0, 0, 0, 0)),
        ("RADIAL", [30, 16, 12, 0.1, 0.2], (0.1, 0.2, 0, 0, 0)),
        ("OPENCV", [30, 31, 16, 12, 0.1, 0.2, 0.01, 0.02], (0.1, 0.2, 0.01, 0.02, 0)),
        ("OPENCV", [30, 31, 16, 12, 0, 0, 0, 0], None),
        (
            "FULL_OPENCV",
            [30, 31, 16, 12, 0.1, 0.2, 0.01, 0.02, 0.3, 0.4, 0.5, 0.6],
            (0.1, 0.2, 0.01, 0.02, 0.3, 0.4, 0.5, 0.6),
        ),
        ("OPENCV_FISHEYE", [30, 31, 16, 12, 0.1, 0.2, 0.3, 0.4], (0.1, 0.2, 0.3, 0.4)),
        ("SIMPLE_RADIAL_FISHEYE", [30, 16, 12, 0.1], (0.1, 0, 0, 0)),
        ("RADIAL_FISHEYE", [30, 16, 12, 0.1, 0.2], (0.1, 0.2, 0, 0)),
    ],
)
def test_camera_models(tmp_path, model, parameters, distortion):
    line = f"1 {model} {WIDTH} {HEIGHT} " + " ".join(map(str, parameters))
    recording = opened(write(tmp_path, line)).recording
    assert recording.distortion == distortion
    assert recording.fisheye == ("FISHEYE" in model)
    assert recording.camera.fx == 30
    assert recording.camera.cx == 15.5


@pytest.mark.parametrize(
    "model",
    ["SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "RADIAL_FISHEYE"],
)
def test_points_are_projected_as_colmap_does(tmp_path, model):
    pycolmap = pytest.importorskip("pycolmap")
    theirs = pycolmap.Camera.create_from_model_name(1, model, 300.0, 640, 480)
    parameters = theirs.params
    free = len(parameters) - (3 if "RADIAL" in model else 4)
    parameters[-free:] = [0.05, -0.02, 0.003, 0.002, 0.01, 0.02, -0.01, 0.005][:free]
    theirs.params = parameters
    file = tmp_path / "cameras.txt"
    file.write_text(f"1 {model} 640 480 " + " ".join(map(str, parameters)))
    ours = read_cameras(file)[1]
    rays = np.array([[0.3, -0.2, 1.0], [-0.5, 0.4, 1.0], [0.0, 0.0, 1.0]])
    expected = np.array([theirs.img_from_cam(ray) for ray in rays]).reshape(-1, 2)
    project = cv2.fisheye.projectPoints if ours.fisheye else cv2.projectPoints
    zero = np.zeros(3)
    K, D = ours.camera.matrix, np.array(ours.distortion)
    arguments = (rays[None], zero, zero, K, D)
    found = project(*arguments)[0].reshape(-1, 2)
    np.testing.assert_allclose(found + 0.5, expected, atol=1e-6)


def test_poses_are_those_that_colmap_reads(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    project = write(tmp_path)
    (project / "sparse/0/points3D.txt").write_text("7 0 0 0 0 0 0 0 2 1\n")
    theirs = pycolmap.Reconstruction(project / "sparse/0")
    found = {image.name: image.cam_from_world().matrix() for image in theirs.images.values()}
    dataset = opened(project)
    for files, T in zip(dataset.recording.files, dataset.ground_truth.T_world_camera, strict=True):
        # COLMAP writes names with spaces, but reads them to the first one.
        name = files.rgb.name.split()[0]
        np.testing.assert_allclose(np.linalg.inv(T)[:3], found[name], atol=1e-9)


def test_similar_cameras_of_several_images_are_averaged(tmp_path):
    cameras = "\n".join(
        f"{i} SIMPLE_RADIAL {WIDTH} {HEIGHT} {focal} 16 12 {k}"
        for i, (focal, k) in enumerate([(30, 0.1), (30.3, 0.2), (29.9, 0.3)], start=1)
    )
    lines = [image_line(index, name, index + 1) for index, name in enumerate(NAMES)]
    recording = opened(write(tmp_path, cameras, lines)).recording
    assert recording.camera.fx == 30.0
    assert recording.distortion == (0.2, 0, 0, 0, 0)
    assert "the median" in recording.flaws[0]


@pytest.mark.parametrize(
    ("cameras", "error", "message"),
    [
        (f"1 FOV {WIDTH} {HEIGHT} 30 31 16 12 0.1", FormatError, "model FOV is not supported"),
        (f"1 PINHOLE {WIDTH} {HEIGHT} 30 16 12", FormatError, "has 4 parameters, not 3"),
        (f"1 PINHOLE {WIDTH} {HEIGHT} -30 31 16 12", FormatError, "line 2: .*fx, fy > 0"),
        ("1 PINHOLE wide", FormatError, "line 2"),
        (PINHOLE.replace("1 P", "2 P"), DatasetError, "has camera 1, which cameras.txt lacks"),
    ],
)
def test_bad_cameras_are_refused(tmp_path, cameras, error, message):
    with pytest.raises(error, match=message):
        opened(write(tmp_path, cameras))


def test_bad_images_are_refused(tmp_path):
    project = write(tmp_path, lines=["1 1 0 0 0 0 0 zero 1 IMG_2.png"])
    with pytest.raises(FormatError, match=r"images\.txt, line 2: expected `id qw"):
        opened(project)
    (project / "sparse/0/images.txt").write_text("# none\n")
    with pytest.raises(DatasetError, match="contains no images"):
        opened(project)
    (project / "sparse/0/images.txt").write_text(image_line(0, "other.png"))
    with pytest.raises(DatasetError, match=r"lacks 1 of 1 images \(other\.png\)"):
        opened(project)


def test_other_folders_are_refused_with_the_remedy(tmp_path):
    project = write(tmp_path)
    (project / "sparse/0/cameras.txt").unlink()
    with pytest.raises(DatasetError, match=r"has no cameras\.bin and images\.bin \(or \.txt\)"):
        opened(project)
    with pytest.raises(DatasetError, match="is not a folder"):
        opened(tmp_path / "none")


def without_spaces(project: Path) -> Path:
    """The project with names that COLMAP's own reader of texts accepts."""
    (project / "images/IMG 11.png").rename(project / "images/IMG_11.png")
    file = project / "sparse/0/images.txt"
    file.write_text(file.read_text().replace("IMG 11", "IMG_11"))
    return project


def as_binary(project: Path) -> Path:
    """The project with a binary model, as COLMAP writes it, instead of a text model."""
    pycolmap = pytest.importorskip("pycolmap")
    model = project / "sparse/0"
    lines = (model / "images.txt").read_text().replace("1.5 2.5 -1 3.5 4.5 7", "1.5 2.5 -1")
    (model / "images.txt").write_text(lines)
    (model / "points3D.txt").write_text("")
    reconstruction = pycolmap.Reconstruction()
    reconstruction.read_text(str(model))
    for file in model.iterdir():
        file.unlink()
    reconstruction.write_binary(str(model))
    return project


def test_a_binary_model_is_read_like_a_text_model(tmp_path):
    text = opened(without_spaces(write(tmp_path / "a")))
    project = as_binary(without_spaces(write(tmp_path / "b")))
    binary = opened(project)
    assert not list(project.rglob("*.txt"))
    assert binary.camera == text.camera
    assert [f.rgb.name for f in binary.recording.files] == [
        f.rgb.name for f in text.recording.files
    ]
    np.testing.assert_allclose(
        binary.ground_truth.T_world_camera, text.ground_truth.T_world_camera, atol=1e-12
    )


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
def test_a_binary_model_that_is_cut_off_raises_wherever_it_ends(tmp_path, name):
    project = as_binary(write(tmp_path))
    file = project / "sparse/0" / name
    whole = file.read_bytes()
    for end in range(len(whole)):
        file.write_bytes(whole[:end])
        with pytest.raises(FormatError, match=rf"{name} ends too early"):
            opened(project)


def test_an_unknown_binary_camera_model_raises(tmp_path):
    project = as_binary(write(tmp_path))
    file = project / "sparse/0/cameras.bin"
    content = bytearray(file.read_bytes())
    content[12] = 99
    file.write_bytes(content)
    with pytest.raises(FormatError, match="camera model 99 is not known"):
        opened(project)


def test_cameras_of_single_images_name_the_option_of_colmap(tmp_path):
    cameras = "\n".join(f"{k + 1} PINHOLE {WIDTH} {HEIGHT} {30 + k} 31 16 12" for k in range(3))
    lines = [image_line(index, name, index + 1) for index, name in enumerate(NAMES)]
    with pytest.raises(DatasetError, match="single_camera 1"):
        opened(write(tmp_path, cameras, lines))
