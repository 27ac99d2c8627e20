"""Live views: viewers share frames, and each sees every one of them."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor

import httpx
import pytest

from stereorig.server.workflows.service import Service

pytestmark = pytest.mark.timeout(120)
SECONDS, RATE_HZ = 4.0, 10.0


def test_viewers_share_a_frame_and_none_is_given_the_one_it_has(client: httpx.Client, service: Service) -> None:
    pair = service.rig.pair
    first = pair.live("cam1", 60.0)
    assert pair.live("cam1", 60.0).sequence == first.sequence
    second = pair.live("cam1", 60.0, after=first.sequence)
    assert second.sequence != first.sequence
    # another viewer, who has the first, is given the second: nothing is exposed for it
    assert pair.live("cam1", 60.0, after=first.sequence).sequence == second.sequence
    assert pair.live("cam1", 60.0, after=second.sequence).sequence not in (first.sequence, second.sequence)


def test_two_views_at_ten_frames_a_second(client: httpx.Client) -> None:
    def frames(cam: str) -> int:
        with client.stream("GET", f"/api/v1/cameras/{cam}/stream.mjpg", params={"rate_hz": RATE_HZ}) as answer:
            parts, until = 0, None
            for data in answer.iter_raw():
                until = until or time.monotonic() + SECONDS
                parts += data.count(b"Content-Type: image/jpeg")
                if time.monotonic() >= until:
                    return parts
        raise AssertionError("the stream ended")

    frames("cam1")  # the first exposure compiles
    with ThreadPoolExecutor(2) as pool:
        for counted in pool.map(frames, ("cam1", "cam2")):
            # ten are asked for; a machine that does other things as well may miss some
            assert 0.65 * RATE_HZ * SECONDS <= counted <= 1.2 * RATE_HZ * SECONDS
