"""Bytes of others as images: nothing is made room for that the data cannot hold."""

import struct
import subprocess
import sys
import zlib

import cv2
import numpy as np
import pytest

from viewmend.capture.errors import CaptureError
from viewmend.capture.images import PART, PNG, decoded, read_mask, read_rgb

IMAGE = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)


def png():
    return cv2.imencode(".png", IMAGE)[1].tobytes()


def part(kind, data, length=None):
    return (
        struct.pack(">I4s", len(data) if length is None else length, kind) + data + struct.pack(">I", zlib.crc32(kind))
    )


def parts_of(data):
    """Where each part of a PNG begins, and its kind."""
    at = len(PNG)
    while at < len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        yield at, kind
        at += PART + length


def test_whole_images_are_decoded_exactly():
    assert np.array_equal(decoded(png(), cv2.IMREAD_COLOR), IMAGE)
    extra = png()[: 8 + 25] + part(b"tEXt", b"a\0b") + png()[8 + 25 :]
    assert np.array_equal(decoded(extra, cv2.IMREAD_COLOR), IMAGE)
    assert np.array_equal(decoded(png() + b"behind the end", cv2.IMREAD_COLOR), IMAGE)
    jpeg = cv2.imencode(".jpg", IMAGE)[1].tobytes()
    assert decoded(jpeg, cv2.IMREAD_COLOR).shape == IMAGE.shape


@pytest.mark.parametrize("length", [0xFFFFFFFF, 0x7FFFFFFF, 10_000])
def test_a_part_that_is_longer_than_the_data_is_refused(length, tmp_path):
    data = png()
    at = next(at for at, kind in parts_of(data) if kind == b"IDAT")
    spoilt = data[:at] + struct.pack(">I", length) + data[at + 4 :]
    assert decoded(spoilt, cv2.IMREAD_COLOR) is None
    (tmp_path / "a.png").write_bytes(spoilt)
    for read in (read_rgb, read_mask):
        with pytest.raises(CaptureError, match="bytes that are none, or cut short"):
            read(tmp_path / "a.png", "here")


def test_images_of_16_bit_are_their_upper_eight_and_dim_ones_are_refused(tmp_path):
    deep = IMAGE.astype(np.uint16) * 256 + 200
    cv2.imwrite(str(tmp_path / "deep.png"), deep)
    assert np.array_equal(read_rgb(tmp_path / "deep.png", "here"), IMAGE[..., ::-1])
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros_like(deep))
    assert not read_rgb(tmp_path / "black.png", "here").any()
    cv2.imwrite(str(tmp_path / "twelve.png"), IMAGE.astype(np.uint16) * 16)
    with pytest.raises(CaptureError, match="16 bit that are used, got uint16 with values up to"):
        read_rgb(tmp_path / "twelve.png", "here")


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_a_jpeg_that_is_cut_short_is_no_grey_picture(share, tmp_path):
    data = cv2.imencode(".jpg", cv2.resize(IMAGE, (320, 240)))[1].tobytes()
    assert decoded(data, cv2.IMREAD_COLOR) is not None
    (tmp_path / "a.jpg").write_bytes(data[: int(share * len(data))])
    with pytest.raises(CaptureError, match="bytes that are none, or cut short"):
        read_rgb(tmp_path / "a.jpg", "here")


@pytest.mark.parametrize("end", [20, 33, 60, -12, -4, -1])
def test_what_is_cut_short_is_refused(end):
    assert decoded(png()[:end], cv2.IMREAD_COLOR) is None


def test_the_end_must_be_a_part_and_not_a_word():
    data = png()
    assert decoded(data[:-PART] + part(b"tEXt", b"IEND"), cv2.IMREAD_COLOR) is None


def test_an_image_of_more_pixels_than_are_wanted_is_refused():
    assert decoded(png(), cv2.IMREAD_COLOR, 32 * 24 - 1) is None and decoded(b"", cv2.IMREAD_COLOR) is None


def test_a_small_file_costs_little_memory(tmp_path):
    """In a process of its own, since a peak of memory never falls."""
    data = png()
    at = next(at for at, kind in parts_of(data) if kind == b"IDAT")
    (tmp_path / "a.png").write_bytes(data[:at] + b"\xff\xff\xff\xff" + data[at + 4 :])
    code = (
        "import resource, sys; from pathlib import Path; from viewmend.capture.images import read_rgb\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "try: read_rgb(Path(sys.argv[1]), 'here')\nexcept ValueError: pass\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "a.png"], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 100_000, "kilobytes"
