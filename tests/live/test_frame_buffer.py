"""The buffer between camera and SLAM: the newest frames are kept, dropped ones are known."""

from __future__ import annotations

import threading

import pytest
from scripted_camera import room_frames

from toolkit.base.errors import CameraError
from toolkit.runs.live.buffer import Delivery, FrameBuffer
from toolkit.runs.live.camera import CapturedFrame

FRAMES = room_frames(5)


def filled(capacity: int) -> FrameBuffer:
    buffer = FrameBuffer(capacity)
    for frame in FRAMES:
        buffer.put(CapturedFrame(frame, 10.0 + frame.index))
    return buffer


def taken(buffer: FrameBuffer) -> Delivery:
    delivery = buffer.take(1.0)
    assert delivery is not None
    return delivery


def test_the_newest_frame_is_kept_and_the_others_are_dropped():
    delivery = taken(filled(1))
    assert delivery.captured is not None
    assert delivery.captured.frame is FRAMES[4]
    assert [frame.index for frame in delivery.dropped] == [0, 1, 2, 3]
    assert delivery.dropped[2].timestamp_s == FRAMES[2].timestamp_s
    assert delivery.dropped[2].captured_s == 12.0


def test_several_frames_are_delivered_in_order_and_drops_once():
    buffer = filled(2)
    first, second = taken(buffer), taken(buffer)
    assert first.captured is not None and second.captured is not None
    assert [first.captured.frame.index, second.captured.frame.index] == [3, 4]
    assert len(first.dropped) == 3
    assert second.dropped == ()


def test_without_a_frame_the_wait_ends():
    assert FrameBuffer().take(0.0) is None


def test_a_frame_ends_the_wait_of_another_thread():
    buffer, found = FrameBuffer(), []
    waiter = threading.Thread(target=lambda: found.append(buffer.take(30.0)))
    waiter.start()
    buffer.put(CapturedFrame(FRAMES[0], 0.0))
    waiter.join(30.0)
    assert found[0].captured.frame is FRAMES[0]


def test_the_frame_that_is_taken_ends_the_wait_for_it():
    buffer = filled(1)
    waiter = threading.Thread(target=lambda: buffer.wait_until_taken(30.0))
    waiter.start()
    assert waiter.is_alive()
    taken(buffer)
    waiter.join(30.0)
    assert not waiter.is_alive()


def test_the_end_and_errors_come_after_the_last_frame():
    buffer = filled(1)
    buffer.end()
    assert taken(buffer).captured is not None
    assert taken(buffer).captured is None
    buffer = filled(1)
    buffer.end(CameraError("unplugged"))
    assert taken(buffer).captured is not None
    with pytest.raises(CameraError, match="unplugged"):
        buffer.take(1.0)
