"""Image files: exact decoding, and untrusted data that are rejected without allocating what they claim."""

import inspect
import struct
import subprocess
import sys
import zlib

import cv2
import numpy as np
import pytest

from viewmend.data import images
from viewmend.data.errors import CaptureError
from viewmend.data.images import (
    PNG_CHUNK_OVERHEAD,
    PNG_START,
    decode_image,
    read_mask,
    read_rgb,
    read_run_lengths,
    write_image,
)

IMAGE = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
PNG = cv2.imencode(".png", IMAGE)[1].tobytes()


def chunk(kind, data):
    return struct.pack(">I4s", len(data), kind) + data + struct.pack(">I", zlib.crc32(kind))


def with_length(length):
    """The PNG with another length of its IDAT chunk."""
    at = len(PNG_START)
    while (found := struct.unpack_from(">I4s", PNG, at))[1] != b"IDAT":
        at += PNG_CHUNK_OVERHEAD + found[0]
    return PNG[:at] + struct.pack(">I", length) + PNG[at + 4 :]


@pytest.mark.parametrize("data", [PNG, PNG[:33] + chunk(b"tEXt", b"a\0b") + PNG[33:], PNG + b"trailing"])
def test_complete_images_are_decoded_exactly(data):
    assert np.array_equal(decode_image(data, cv2.IMREAD_COLOR), IMAGE)


@pytest.mark.parametrize("length", [0xFFFFFFFF, 0x7FFFFFFF, 10_000])
def test_chunks_longer_than_the_data_are_rejected(length, tmp_path):
    assert decode_image(with_length(length), cv2.IMREAD_COLOR) is None
    (tmp_path / "a.png").write_bytes(with_length(length))
    for read in (read_rgb, read_mask):
        with pytest.raises(CaptureError, match="not an image or are truncated"):
            read(tmp_path / "a.png", "here")


@pytest.mark.parametrize("end", [0, 20, 33, 60, -12, -4, -1])
def test_truncated_images_are_rejected(end):
    assert decode_image(PNG[:end], cv2.IMREAD_COLOR) is None


def test_iend_in_a_text_is_not_the_end():
    assert decode_image(PNG[:-PNG_CHUNK_OVERHEAD] + chunk(b"tEXt", b"IEND"), cv2.IMREAD_COLOR) is None


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_truncated_jpegs_are_rejected(share, tmp_path):
    data = cv2.imencode(".jpg", cv2.resize(IMAGE, (320, 240)))[1].tobytes()
    assert decode_image(data, cv2.IMREAD_COLOR) is not None
    (tmp_path / "a.jpg").write_bytes(data[: int(share * len(data))])
    with pytest.raises(CaptureError, match="not an image or are truncated"):
        read_rgb(tmp_path / "a.jpg", "here")


def test_the_number_of_pixels_is_limited(monkeypatch):
    for limit in (32 * 24, 32 * 24 - 1):
        monkeypatch.setattr(images, "MAX_PIXELS", limit)
        assert (decode_image(PNG, cv2.IMREAD_COLOR) is None) == (limit < 32 * 24)


def test_16_bit_images_need_their_full_range(tmp_path):
    def read(image):
        cv2.imwrite(str(tmp_path / "a.png"), image)
        return read_rgb(tmp_path / "a.png", "here")

    deep = IMAGE.astype(np.uint16) * 256 + 200
    assert np.array_equal(read(deep), IMAGE[..., ::-1]) and not read(np.zeros_like(deep)).any()
    with pytest.raises(CaptureError, match="16 bit in full range, got uint16 with values up to"):
        read(IMAGE.astype(np.uint16) * 16)


def test_a_malformed_file_costs_little_memory(tmp_path):
    """Runs in its own process, since the memory peak of a process never falls."""
    (tmp_path / "a.png").write_bytes(with_length(0xFFFFFFFF))
    code = (
        "import resource, sys; from pathlib import Path; from viewmend.data.images import read_rgb\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "try: read_rgb(Path(sys.argv[1]), 'here')\nexcept ValueError: pass\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "a.png"], capture_output=True, text=True, check=True
    )
    assert int(done.stdout) < 100_000, "kilobytes"


def test_run_lengths_follow_the_format(tmp_path):
    (tmp_path / "a.bin").write_bytes(np.array([1, 1, 4, 5, 6], "<i4").tobytes())
    assert read_run_lengths(tmp_path / "a.bin", "mask", (2, 3)).tolist() == [[255, 0, 0], [0, 255, 0]]
    (tmp_path / "b.bin").write_bytes(np.array([0, 12], "<i4").tobytes())
    assert not read_run_lengths(tmp_path / "b.bin", "mask", (3, 4)).any()


@pytest.mark.parametrize("runs", [[0], [2, 12], [0, 5, 4, 12], [0, 13], [], [0, -2, 12]])
@pytest.mark.parametrize("extra", [b"", b"x"])
def test_invalid_run_lengths_are_rejected(tmp_path, runs, extra):
    (tmp_path / "a.bin").write_bytes(np.array(runs, "<i4").tobytes() + extra)
    with pytest.raises(CaptureError, match="expected runs of 0 and 1 that end at 4 x 3 = 12 pixels"):
        read_run_lengths(tmp_path / "a.bin", "a.bin: camera '1'", (3, 4))


@pytest.mark.parametrize("image", [IMAGE / 255, IMAGE > 0, IMAGE[..., :2], IMAGE.tolist()])
def test_only_images_of_8_bit_are_written(image, tmp_path):
    write_image(tmp_path / "grey.png", IMAGE[..., :1])
    write_image(str(tmp_path / "right.png"), IMAGE)
    assert np.array_equal(read_rgb(tmp_path / "right.png", "right"), IMAGE)
    unchecked = inspect.unwrap(write_image)  # types are checked in some runs of the tests
    with pytest.raises(ValueError, match=r"expected a numpy array of uint8 .*; convert values in"):
        unchecked(tmp_path / "wrong.png", image)
