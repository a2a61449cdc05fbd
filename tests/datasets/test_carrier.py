"""What moves with the camera is found in its images, and what only looks constant is not."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
import yaml
from moving_room import CAMERA, exposed

from toolkit.base.errors import RunFolderError
from toolkit.base.frame import Frame
from toolkit.datasets.carrier import CellImages, find_carrier
from toolkit.datasets.checks import check_recording
from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.registry import describe, open_dataset
from toolkit.io import images
from toolkit.runs.processed_frames import check_identity, identity_of

HEIGHT, WIDTH = CAMERA.height, CAMERA.width
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH]
BODIES = {
    "lowest 20 %": ROWS >= 0.8 * HEIGHT,
    "a side": COLUMNS < 0.15 * WIDTH,
    "around the edges": (np.abs(ROWS / HEIGHT - 0.5) > 0.4) | (np.abs(COLUMNS / WIDTH - 0.5) > 0.4),
    "a hand": ((COLUMNS - 70.0) / 14.0) ** 2 + ((ROWS - 72.0) / 30.0) ** 2 < 1.0,
}


def room(frames: int = 16, moves: bool = True) -> list[Frame]:
    """A textured room; the camera moves, or stands still."""
    times_s = np.linspace(0.0, 8.0, frames) if moves else np.zeros(frames)
    return [
        Frame(n, n / 10.0, *exposed(np.full(HEIGHT, time_s)), CAMERA)
        for n, time_s in enumerate(times_s)
    ]


def with_body(frames: Iterable[Frame], body: np.ndarray, tremor_px: float = 0.0) -> list[Frame]:
    """The frames behind a body at half a metre, with the noise of a sensor."""
    rng, shown = np.random.default_rng(0), []
    for frame in frames:
        shift = np.rint(rng.normal(0.0, tremor_px, 2)).astype(int)
        hides = np.roll(body, shift, axis=(0, 1))
        depth_m = np.where(hides, 0.5 + 0.001 * ROWS, frame.depth_m)
        depth_m += 0.002 * depth_m**2 * rng.normal(size=depth_m.shape)
        rgb = np.where(hides[..., None], [0.6, 0.45, 0.4], frame.rgb)
        rgb += 0.02 * rng.normal(size=rgb.shape)
        rgb, depth_m = rgb.clip(0.0, 1.0).astype(np.float32), depth_m.astype(np.float32)
        shown.append(replace(frame, rgb=rgb, depth_m=depth_m))
    return shown


def found_in(frames: Iterable[Frame]) -> np.ndarray:
    mask = find_carrier([CellImages.of(frame) for frame in frames])
    rows = np.arange(HEIGHT) * mask.shape[0] // HEIGHT
    return mask[np.ix_(rows, np.arange(WIDTH) * mask.shape[1] // WIDTH)]


@pytest.mark.parametrize("name", BODIES)
def test_a_body_is_found(name):
    body = BODIES[name]
    found = found_in(with_body(room(), body))
    assert found[body].all()
    assert found.mean() < body.mean() + 0.12  # its border


def test_a_hand_with_tremor_is_found():
    hand = BODIES["a hand"]
    assert found_in(with_body(room(), hand, tremor_px=1.0))[hand].mean() > 0.9


def test_a_body_with_gaps_in_its_depth_is_found():
    rng, body = np.random.default_rng(1), BODIES["lowest 20 %"]
    frames = [
        replace(f, depth_m=np.where(body & (rng.random(body.shape) < 0.4), 0.0, f.depth_m))
        for f in with_body(room(), body)
    ]
    frames = [replace(f, depth_m=f.depth_m.astype(np.float32)) for f in frames]
    assert found_in(frames)[body].all()


def blank_floor(frame: Frame, wall_m: float) -> Frame:
    """A floor of one colour, seen by a robot, up to a textured wall."""
    below = np.maximum(ROWS - CAMERA.cy, 1e-3)
    floor_m = 0.4 * CAMERA.fy / below
    depth_m = np.minimum(floor_m, wall_m).astype(np.float32)
    rgb = np.where((floor_m < wall_m)[..., None], np.float32(0.6), frame.rgb)
    return replace(frame, rgb=rgb, depth_m=depth_m)


def blank_wall(frame: Frame, shift: int) -> Frame:
    """A wall of one colour, with pictures in its upper half that pass by."""
    picture = (ROWS < 0.5 * HEIGHT) & ((COLUMNS + shift) % 40 < 32)
    rgb = np.where(picture[..., None], frame.rgb, np.float32(0.7))
    return replace(frame, rgb=rgb, depth_m=np.where(picture, 1.95, 2.0).astype(np.float32))


def passer_by(frame: Frame) -> Frame:
    """Somebody who walks through the view."""
    place = np.abs(COLUMNS - 6 * frame.index) < 12
    rgb = np.where(place[..., None], np.float32([0.1, 0.2, 0.9]), frame.rgb)
    return replace(frame, rgb=rgb, depth_m=np.where(place, np.float32(1.0), frame.depth_m))


@pytest.mark.parametrize(
    "frames",
    [
        room(),
        room(moves=False),
        with_body(room(moves=False), BODIES["lowest 20 %"]),
        with_body(map(passer_by, room(moves=False)), BODIES["lowest 20 %"]),
        [blank_floor(frame, 1.5 + 0.2 * (n % 7)) for n, frame in enumerate(room())],
        [blank_wall(frame, 7 * n) for n, frame in enumerate(room())],
        room(2),
        [],
    ],
    ids=[
        *("room", "still", "body of a still camera", "somebody passes by"),
        *("blank floor", "blank wall", "two frames", "no frames"),
    ],
)
def test_nothing_else_is_found(frames):
    assert not find_carrier([CellImages.of(frame) for frame in frames]).any()


@pytest.fixture(scope="module")
def body_recording(tmp_path_factory):
    """A recording with a body in the lowest fifth of its images. Read only."""
    folder = tmp_path_factory.mktemp("robot") / "robot"
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    for frame in with_body(room(6), BODIES["lowest 20 %"]):
        images.write_rgb(folder / "rgb" / f"{frame.index:03d}.png", frame.rgb)
        images.write_depth_png(folder / "depth" / f"{frame.index:03d}.png", frame.depth_m, 1000.0)
    intrinsics = {name: getattr(CAMERA, name) for name in ("fx", "fy", "cx", "cy")}
    intrinsics |= {"width": WIDTH, "height": HEIGHT, "depth_scale": 1000.0, "fps": 5.0}
    (folder / "intrinsics.yaml").write_text(yaml.safe_dump(intrinsics))
    return folder


def test_check_data_says_so(body_recording):
    report = check_recording(describe("folder", body_recording))
    lines = [line for line in report.notes if "moves with the camera" in line]
    assert len(lines) == 1
    assert lines[0].startswith("22% of the image (lowest 22%) moves with the camera")


@pytest.mark.parametrize("size", [None, (48, 36), (48, 30)], ids=["native", "smaller", "cropped"])
def test_it_is_ignored_in_the_frames_of_a_run(body_recording, size):
    frame = open_dataset("folder", body_recording, size)[3]
    assert frame.ignored is not None
    np.testing.assert_array_equal(frame.depth_m > 0, ~frame.ignored)
    rows = np.flatnonzero(frame.ignored.all(axis=1))
    assert rows[-1] == frame.camera.height - 1
    # The border between body and room, in the rows of the image.
    assert abs(rows[0] - (0.77 * HEIGHT - 35.5) * frame.camera.fy / CAMERA.fy - frame.camera.cy) < 2
    whole = DatasetOptions(ignore_carrier=False)
    assert open_dataset("folder", body_recording, size, options=whole)[3].ignored is None


def test_a_run_is_resumed_with_the_same_mask_only(body_recording):
    first, again = (open_dataset("folder", body_recording) for _ in range(2))
    np.testing.assert_array_equal(first.recording.carrier, again.recording.carrier)
    saved = identity_of(first, 6, given_poses=False)
    check_identity(saved, identity_of(again, 6, given_poses=False), "run")
    other = open_dataset("folder", body_recording, options=DatasetOptions(ignore_carrier=False))
    with pytest.raises(RunFolderError, match="what moves with the camera"):
        check_identity(saved, identity_of(other, 6, given_poses=False), "run")
