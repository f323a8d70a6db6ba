"""Pickles of numbers, strings, lists, dicts and arrays are read as by unpickling; everything else is rejected."""

import codecs
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from viewmend.utils.safe_pickle import Stored, numbers, read_objects

DTYPES, SHAPES = ["<f8", ">f8", "<f4", "<i4", ">i8", "|u1", "|b1"], [(3,), (2, 3), (0,), (1, 2, 2)]
ARRAYS = st.builds(
    lambda dtype, shape: np.arange(np.prod(shape)).astype(dtype).reshape(shape),
    st.sampled_from(DTYPES),
    st.sampled_from(SHAPES),
)
LEAVES = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(allow_nan=False), st.text(), ARRAYS)
VALUES = st.recursive(
    LEAVES, lambda v: st.lists(v) | st.tuples(v, v) | st.dictionaries(st.text(), v), max_leaves=8
)


def to_lists(value):
    """The value with arrays as lists."""
    value = value.value if isinstance(value, Stored) else value
    if isinstance(value, np.ndarray):
        return [value.dtype.kind, value.dtype.itemsize, value.tolist()]
    if isinstance(value, list | tuple):
        return type(value)(to_lists(item) for item in value)
    return {key: to_lists(item) for key, item in value.items()} if isinstance(value, dict) else value


@pytest.fixture
def read(tmp_path):
    def read(data, suffix="pkl"):
        (tmp_path / f"a.{suffix}").write_bytes(data)
        return read_objects(tmp_path / f"a.{suffix}")

    return read


@settings(max_examples=100, deadline=None, database=None, derandomize=True)
@given(VALUES, st.sampled_from(range(6)), st.booleans(), st.booleans())
def test_values_round_trip(tmp_path_factory, value, protocol, fortran, numpy_1):
    if fortran and isinstance(value, np.ndarray):
        value = np.asfortranarray(value)
    data = pickle.dumps(value, protocol)
    if numpy_1 and protocol < 4:
        data = data.replace(b"numpy._core.", b"numpy.core.")
    file = tmp_path_factory.getbasetemp() / "a.pkl"
    file.write_bytes(data)
    assert to_lists(read_objects(file)) == to_lists(value)


@pytest.mark.parametrize("scalar", [np.float64(1.5), np.float32(0.25), np.int64(7), 1.5, 3])
def test_scalars_are_numbers(read, scalar):
    for protocol in range(2, 6):
        assert numbers(read(pickle.dumps(scalar, protocol)), 1).tolist() == [float(scalar)]


def test_npy_files_have_one_object(read, tmp_path):
    np.save(tmp_path / "b.npy", {"a": [np.eye(3)]}, allow_pickle=True)
    assert numbers(read_objects(tmp_path / "b.npy")["a"], 3, 3).tolist() == np.eye(3).tolist()
    np.save(tmp_path / "b.npy", np.eye(3))
    with pytest.raises(ValueError, match=r"got an array with the header \{'descr': '<f8'"):
        read_objects(tmp_path / "b.npy")
    with pytest.raises(ValueError, match=r"in a\.npy"):
        read((tmp_path / "b.npy").read_bytes()[:9], "npy")


class Malicious:
    def __reduce__(self):
        return open, ("made", "w")


def test_nothing_is_called(read, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for protocol in range(6):
        for value in (Malicious(), [Malicious()], {"a": Malicious()}):
            data = pickle.dumps(value, protocol)
            with pytest.raises(
                ValueError, match=r"got (_?io|builtins|__builtin__)\.open; is it the right file"
            ):
                read(data)
    assert not (tmp_path / "made").exists()
    pickle.loads(data)["a"].close()  # unpickling would have opened the file
    assert (tmp_path / "made").exists()


def test_recursive_lists_are_bounded(read):
    value: list = [1.0]
    for _ in range(60):
        value = [value, value]
    endless: list = []
    endless.append(endless)
    for nested in (value, endless):
        with pytest.raises(ValueError, match="expected 9 numbers, got"):
            numbers(read(pickle.dumps(nested)), 3, 3)


@pytest.mark.parametrize("function", [codecs.encode, np.dtype])
def test_nested_lists_do_not_become_text(read, function):
    class Named:
        def __reduce__(self):
            value: list = ["f8"]
            for _ in range(60):
                value = [value, value]
            return function, (value,)

    with pytest.raises(ValueError, match="got text of type list"):
        read(pickle.dumps(Named()))


@pytest.mark.parametrize(
    "value", [np.array(["a"]), np.array([1j]), np.array([(1, 2.0)], [("a", int), ("b", float)])]
)
def test_other_arrays_are_rejected(read, value):
    with pytest.raises(ValueError, match="expected numbers, strings, lists, dicts and arrays"):
        read(pickle.dumps(value))


def test_invalid_escapes_do_not_warn(read):
    assert read(b"S'a\\c'\n.") == "a\\c"
