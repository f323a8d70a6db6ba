"""What OpenCV wrote is read as OpenCV would read it, without its parser; what nobody could have written is refused."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from viewmend.capture.formats.opencv_storage import MOST_BYTES, read_storage

FILES = ("a.yml", "a.xml", "a.json")
ROW = np.float32([[0.1, -3e38, 1e-40]])
VALUES = st.lists(st.floats(width=64, allow_nan=True, allow_infinity=True), min_size=9, max_size=9)


def written(file, matrices, names=("00", "cam 1", "7")):
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    for key, matrix in matrices.items():
        storage.write(key, matrix)
    storage.startWriteStruct("names", cv2.FileNode_SEQ)
    for name in names:
        storage.write("", name)
    storage.endWriteStruct()
    storage.release()
    return file


@pytest.mark.parametrize("name", FILES)
@settings(max_examples=25, deadline=None)
@given(values=VALUES, number=st.integers(-(2**31), 2**31 - 1))
def test_what_opencv_wrote_is_read_as_opencv_reads_it(name, values, number, tmp_path_factory):
    K = np.array(values).reshape(3, 3)
    colours = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    matrices = {"K_00": K, "row": ROW, "colours": colours, "n": number, "f": K[0, 0], "t": "a: b"}
    file = written(tmp_path_factory.mktemp("storage") / name, matrices)
    found, storage = read_storage(file), cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    for key in ("K_00", "row", "colours"):
        expected = storage.getNode(key).mat().ravel()  # float32 where the file says so
        np.testing.assert_array_equal(found[key].astype(expected.dtype), expected, err_msg=key)
    assert found["n"] == number and found["names"] == ["00", "cam 1", "7"] and "t" not in found
    np.testing.assert_equal(found["f"], storage.getNode("f").real())


def test_names_without_quotes_keep_their_zeros(tmp_path):
    (tmp_path / "a.yml").write_text("%YAML:1.0\n---\nnames:\n   - 00\n   - 010\n   - 1e3\n")
    assert read_storage(tmp_path / "a.yml")["names"] == ["00", "010", "1e3"]


MATRIX = "%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: {}\n   cols: {}\n   dt: {}\n   data: [ {} ]\n"
REFUSED = {
    "brackets without end": (b"a: " + b"[" * 100_000, "expected OpenCV's YAML or XML in a.yml, got"),
    "a list that is not closed": (b"a: [1, 2", "expected OpenCV's YAML or XML in a.yml, got: did not find expected"),
    "no keys": (b"- 1\n- 2\n", "got no keys"),
    "keys that are lists": (b"? [1]\n: 2\n", "expected OpenCV's YAML or XML in a.yml, got"),
    "control characters": (b"a: \1\n", "expected OpenCV's YAML or XML in a.yml, got"),
    "no text": (b"\xff\xfe\xfd", "can't decode"),
    "entities": (b'<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "without a document type"),
    "too large": (b" " * (MOST_BYTES + 1), "expected a.yml to have at most"),
    "fewer than said": (MATRIX.format(3, 3, "d", "1, 2").encode(), "K: expected rows x cols numbers, got 2"),
    "more than said": (MATRIX.format(1, 1, "d", "1, 2").encode(), "K: expected rows x cols numbers, got 2"),
    "channels forgotten": (MATRIX.format(1, 2, "3u", "1, 2").encode(), "K: expected rows x cols numbers, got 2"),
    "words": (MATRIX.format(1, 2, "d", "1, two").encode(), "or some that are none"),
    "no type": (MATRIX.format(1, 2, "[d]", "1, 2").encode(), "K: expected rows x cols"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_opencv_did_not_write_is_refused_in_one_line(what, tmp_path):
    data, message = REFUSED[what]
    (tmp_path / "a.yml").write_bytes(data)
    with pytest.raises(ValueError, match=message) as refused:
        read_storage(tmp_path / "a.yml")
    assert "\n" not in str(refused.value) and len(str(refused.value)) < 200


def test_references_to_references_do_not_grow(tmp_path):
    lines = ["a0: &a0 [1, 1]", *(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]" for i in range(1, 60))]
    (tmp_path / "a.yml").write_text("\n".join(lines))
    assert read_storage(tmp_path / "a.yml") == {}
