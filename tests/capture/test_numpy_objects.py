"""Pickles of arrays are read without being unpickled, and give what unpickling gives; all else is refused."""

import io
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from viewmend.capture.formats.numpy_objects import Stored, numbers, read_objects

PROTOCOLS = st.sampled_from(range(6))
ARRAYS = st.tuples(
    st.sampled_from(["<f8", ">f8", "<f4", "<i4", ">i8", "|u1", "|b1"]), st.sampled_from([(3,), (2, 3), (0,), (1, 2, 2)])
).map(lambda told: np.arange(np.prod(told[1])).astype(told[0]).reshape(told[1]))
LEAVES = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(allow_nan=False), st.text(), ARRAYS)
VALUES = st.recursive(LEAVES, lambda v: st.lists(v) | st.tuples(v, v) | st.dictionaries(st.text(), v), max_leaves=8)


def plain(value):
    """The value with arrays as lists."""
    value = value.value if isinstance(value, Stored) else value
    if isinstance(value, np.ndarray):
        return [value.dtype.kind, value.dtype.itemsize, value.tolist()]
    if isinstance(value, list | tuple):
        return type(value)(plain(item) for item in value)
    return {key: plain(item) for key, item in value.items()} if isinstance(value, dict) else value


@settings(max_examples=100, deadline=None, database=None, derandomize=True)
@given(VALUES, PROTOCOLS, st.booleans(), st.booleans())
def test_what_was_pickled_is_read(tmp_path_factory, value, protocol, fortran, former):
    if fortran and isinstance(value, np.ndarray):
        value = np.asfortranarray(value)
    data = pickle.dumps(value, protocol)
    if former and protocol < 4:
        data = data.replace(b"numpy._core.", b"numpy.core.")
    file = tmp_path_factory.getbasetemp() / "a.pkl"
    file.write_bytes(data)
    assert plain(read_objects(file)) == plain(value)


@pytest.mark.parametrize("scalar", [np.float64(1.5), np.float32(0.25), np.int64(7), 1.5, 3])
def test_numbers_of_numpy_are_numbers(tmp_path, scalar):
    for protocol in range(2, 6):
        (tmp_path / "a.pkl").write_bytes(pickle.dumps(scalar, protocol))
        assert numbers(read_objects(tmp_path / "a.pkl"), 1).tolist() == [float(scalar)]


def test_a_file_of_numpy_holds_one_object(tmp_path):
    np.save(tmp_path / "a.npy", {"a": [np.eye(3)]}, allow_pickle=True)  # pyright: ignore[reportArgumentType]
    assert numbers(read_objects(tmp_path / "a.npy")["a"], 3, 3).tolist() == np.eye(3).tolist()
    np.save(tmp_path / "a.npy", np.eye(3))
    with pytest.raises(ValueError, match=r"got an array with the header \{'descr': '<f8'"):
        read_objects(tmp_path / "a.npy")


class Evil:
    def __reduce__(self):
        return open, ("made", "w")


def test_nothing_is_called(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for protocol in range(6):
        for value in (Evil(), [Evil()], {"a": Evil()}):
            (tmp_path / "a.pkl").write_bytes(pickle.dumps(value, protocol))
            with pytest.raises(ValueError, match=r"got (_?io|builtins|__builtin__)\.open; is it the right file"):
                read_objects(tmp_path / "a.pkl")
    pickle.loads((tmp_path / "a.pkl").read_bytes())["a"].close()  # this is what it would have done
    assert (tmp_path / "made").exists()


def test_lists_of_lists_of_the_same_list_cost_nothing(tmp_path):
    value: list = [1.0]
    for _ in range(60):
        value = [value, value]
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(value))
    with pytest.raises(ValueError, match="expected 9 numbers, got"):
        numbers(read_objects(tmp_path / "a.pkl"), 3, 3)
    endless: list = []
    endless.append(endless)
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(endless))
    with pytest.raises(ValueError, match="expected 9 numbers"):
        numbers(read_objects(tmp_path / "a.pkl"), 3, 3)


def test_arrays_of_other_things_are_refused(tmp_path):
    for value in (np.array(["a"]), np.array([1j]), np.array([(1, 2.0)], [("a", int), ("b", float)])):
        (tmp_path / "a.pkl").write_bytes(pickle.dumps(value))
        with pytest.raises(ValueError, match="expected numbers, texts, lists, dicts and arrays"):
            read_objects(tmp_path / "a.pkl")
    stream = io.BytesIO()
    np.save(stream, np.eye(2))
    (tmp_path / "a.npy").write_bytes(stream.getvalue()[:9])
    with pytest.raises(ValueError, match=r"in a\.npy"):
        read_objects(tmp_path / "a.npy")


def test_a_text_with_an_escape_that_is_none_is_read_without_a_warning(tmp_path):
    (tmp_path / "a.pkl").write_bytes(b"S'a\\c'\n.")
    assert read_objects(tmp_path / "a.pkl") == "a\\c"
