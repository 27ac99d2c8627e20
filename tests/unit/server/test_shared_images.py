"""Images in memory that two processes share."""

import multiprocessing

import numpy as np
import pytest

from stereorig.server.worker.shared_images import SharedImages


def pair(seed: int, shape: tuple[int, int], kind: type) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.integers(0, 200, shape).astype(kind) for _ in range(2)]


def answer(connection) -> None:
    """Send back what lies where one is told."""
    while (placed := connection.recv()) is not None:
        connection.send(placed.read())


def test_another_process_reads_what_was_put_in_whatever_its_size() -> None:
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=answer, args=(theirs,), daemon=True)
    process.start()
    shared = SharedImages()
    # smaller ones, larger ones, of another type, and a view whose rows do not follow one another
    sent = [pair(1, (37, 41), np.uint8), pair(2, (90, 70), np.uint16), pair(3, (37, 41), np.uint8)]
    sent.append([image[::2, 3:60] for image in pair(4, (90, 70), np.uint16)])
    for images in sent:
        ours.send(shared.put(images))
        for one, other in zip(images, ours.recv(), strict=True):
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)
    ours.send(None)
    process.join()
    shared.close()
    shared.close()


def test_images_that_were_read_stay_when_the_next_ones_come() -> None:
    shared, first = SharedImages(), pair(1, (40, 40), np.uint8)
    read = shared.put(first).read()
    shared.put(pair(2, (40, 40), np.uint8))
    for one, other in zip(first, read, strict=True):
        np.testing.assert_array_equal(one, other)
    shared.close()
    with pytest.raises(ValueError, match="closed"):
        shared.put(first)
