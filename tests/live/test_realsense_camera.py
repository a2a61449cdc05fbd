"""RealSense cameras, with the library's own software device in place of a connected one."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from toolkit.base.errors import CameraError, DependencyError
from toolkit.runs.live.realsense import RealSenseCamera
from toolkit.tools.cli.main import main

rs = pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed")

WIDTH, HEIGHT = 64, 48
BASELINE_M, DEPTH_F, COLOUR_F = 0.05, 60.0, 50.0


class SoftwareDevice:
    """Sends synthetic pairs of images through the library.

    Args:
        coefficients: of the colour image's lens distortion.
        depth_mm: depth image.
        system_clock: stamp images with the clock of the system instead of the camera's.
    """

    def __init__(self, coefficients=(0.0,) * 5, depth_mm=None, system_clock=False) -> None:
        self.depth_mm = np.full((HEIGHT, WIDTH), 1500, np.uint16) if depth_mm is None else depth_mm
        self.rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        self.rgb[:, WIDTH // 2 :] = (250, 120, 10)
        self.number, self.running, self.fails = 0, False, False
        self._system_clock = system_clock
        self._device = rs.software_device()
        self._sensor = self._device.add_sensor("Stereo Module")
        formats = ((rs.stream.depth, rs.format.z16, 2), (rs.stream.color, rs.format.rgb8, 3))
        lenses = ((DEPTH_F, (0.0,) * 5), (COLOUR_F, coefficients))
        self._profiles = [
            self._sensor.add_video_stream(_stream(uid, *kind, *lens))
            for uid, (kind, lens) in enumerate(zip(formats, lenses, strict=True))
        ]
        self._sensor.add_read_only_option(rs.option.depth_units, 0.001)
        motion = rs.extrinsics()
        motion.rotation, motion.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [BASELINE_M, 0, 0]
        self._profiles[0].register_extrinsics_to(self._profiles[1], motion)
        # The library's syncer pairs images by their arrival, which a test cannot determine.
        self._single, self._pairs = rs.frame_queue(4, keep_frames=True), rs.frame_queue(4)
        self._waiting: list[Any] = []
        self._pairing = rs.processing_block(self._pair)
        self._pairing.start(self._pairs)

    def start(self) -> None:
        self._sensor.open(self._profiles)
        self._sensor.start(self._single)
        self.running = True

    def wait(self, timeout_ms: int) -> Any | None:
        if self.fails:
            raise RuntimeError("Device disconnected")
        for profile, image in zip(self._profiles, (self.depth_mm, self.rgb), strict=True):
            self._sensor.on_video_frame(self._frame(profile, image))
            self._pairing.invoke(self._single.wait_for_frame(1000))
        self.number += 1
        return self._pairs.wait_for_frame(1000).as_frameset()

    def stop(self) -> None:
        self.running = False
        self._sensor.stop()
        self._sensor.close()

    def _pair(self, frame: Any, source: Any) -> None:
        self._waiting.append(frame)
        if len(self._waiting) == 2:
            source.frame_ready(source.allocate_composite_frame(self._waiting))
            self._waiting.clear()

    def _frame(self, profile: Any, image: np.ndarray) -> Any:
        domains = rs.timestamp_domain
        now_ms = 1e3 * time.time() - 40.0 if self._system_clock else 1000 + 33.0 * self.number
        frame = rs.software_video_frame()
        frame.pixels, frame.bpp = image, image.itemsize * (3 if image.ndim == 3 else 1)
        frame.stride = WIDTH * frame.bpp
        frame.timestamp, frame.frame_number = now_ms, self.number
        frame.domain = domains.system_time if self._system_clock else domains.hardware_clock
        frame.profile = profile.as_video_stream_profile()
        frame.depth_units = 0.001
        return frame


def _stream(uid: int, kind, layout, bpp: int, focal: float, coefficients) -> Any:
    stream, lens = rs.video_stream(), rs.intrinsics()
    lens.width, lens.height = WIDTH, HEIGHT
    lens.ppx, lens.ppy, lens.fx, lens.fy = WIDTH / 2, HEIGHT / 2, focal, focal
    lens.model, lens.coeffs = rs.distortion.brown_conrady, list(coefficients)
    stream.type, stream.index, stream.uid, stream.fmt, stream.bpp = kind, 0, uid, layout, bpp
    stream.width, stream.height, stream.fps, stream.intrinsics = WIDTH, HEIGHT, 30, lens
    return stream


def captured(device: SoftwareDevice, count: int):
    camera = RealSenseCamera(source=device)
    intrinsics = camera.start()
    frames = camera.frames()
    found = [next(frames) for _ in range(count)]
    camera.stop()
    assert list(frames) == []
    return intrinsics, camera, found


def test_frames_have_images_times_and_intrinsics_of_the_camera():
    device = SoftwareDevice()
    intrinsics, camera, found = captured(device, 3)
    assert (intrinsics.fx, intrinsics.cx, intrinsics.size) == (50.0, 32.0, (WIDTH, HEIGHT))
    assert camera.depth_scale == pytest.approx(1000.0)
    assert not device.running
    times_s = [c.frame.timestamp_s for c in found]
    assert times_s == sorted(set(times_s))
    assert [c.frame.index for c in found] == [0, 1, 2]
    np.testing.assert_allclose(found[0].frame.rgb, device.rgb / 255.0, atol=1e-6)


def test_depth_is_aligned_to_the_colour_image():
    depth_mm = np.full((HEIGHT, WIDTH), 2000, np.uint16)
    depth_mm[:, WIDTH // 2 :] = 1000
    _, _, found = captured(SoftwareDevice(depth_mm=depth_mm), 1)
    depth_m = found[0].frame.depth_m
    # The edge of the near surface, in the colour camera: its column at the baseline's parallax.
    edge = WIDTH / 2 + COLOUR_F * BASELINE_M / 1.0
    row = depth_m[HEIGHT // 2]
    assert row[int(edge) + 2] == pytest.approx(1.0, abs=1e-3)
    assert row[int(edge) - 3] != pytest.approx(1.0, abs=0.1)
    # Where the narrower depth camera sees nothing, there is no depth.
    assert row[0] == 0.0


def test_lens_distortion_is_removed_from_colour_and_depth():
    coefficients = (0.3, 0.0, 0.0, 0.0, 0.0)
    _, _, plain = captured(SoftwareDevice(), 1)
    device = SoftwareDevice(coefficients)
    camera = RealSenseCamera(source=device)
    camera.start()
    # A bright spot at a distorted position appears where the ray of its pixel is.
    ray = np.array([0.3, 0.2])
    factor = 1.0 + coefficients[0] * float(ray @ ray)
    column, row = np.rint(COLOUR_F * factor * ray + (WIDTH / 2, HEIGHT / 2)).astype(int)
    device.rgb = np.zeros_like(device.rgb)
    device.rgb[row, column] = 255
    frames = camera.frames()
    spot = next(f.frame.rgb for f in frames if f.frame.rgb[..., 1].sum() < 5.0)
    camera.stop()
    found = np.array(np.unravel_index(spot[..., 1].argmax(), spot.shape[:2]))[::-1]
    expected = COLOUR_F * ray + (WIDTH / 2, HEIGHT / 2)
    assert np.abs(found - expected).max() <= 1.0
    assert np.abs(expected - (column, row)).max() > 0.5  # the test can fail
    assert plain[0].frame.rgb.shape == spot.shape


def test_the_time_of_capture_is_that_of_the_camera_on_a_shared_clock():
    _, _, found = captured(SoftwareDevice(system_clock=True), 1)
    age_s = time.monotonic() - found[0].captured_s
    assert age_s >= 0.04


def test_an_error_of_the_driver_is_a_camera_error():
    device = SoftwareDevice()
    camera = RealSenseCamera(source=device)
    camera.start()
    frames = camera.frames()
    next(frames)
    device.fails = True
    with pytest.raises(CameraError, match="Device disconnected"):
        list(frames)
    camera.stop()


no_camera = pytest.mark.skipif(
    len(rs.context().query_devices()) > 0, reason="a RealSense camera is connected"
)


@no_camera
def test_a_missing_camera_is_one_line_with_the_remedy():
    with pytest.raises(CameraError, match="connect it to a USB 3 port"):
        RealSenseCamera().start()


@no_camera
def test_the_program_reports_a_missing_camera_before_it_writes(tmp_path, capsys):
    assert main(["live", "--camera", "realsense", "--out", str(tmp_path / "run")]) == 2
    assert "cannot start the RealSense camera" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_missing_package_names_the_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyrealsense2", None)
    with pytest.raises(DependencyError, match=r"pip install 'semsplat\[realsense\]'"):
        RealSenseCamera()
