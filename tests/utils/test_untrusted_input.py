"""What is said of input is one short line, whatever the input holds."""

import pickle

import pytest

from viewmend.data.errors import CaptureError
from viewmend.live.protocol import ProtocolError
from viewmend.training.run_files import RunError
from viewmend.training.shards import ShardError
from viewmend.utils.untrusted_input import MOST_CHARACTERS, InputError, bounded_bytes
from viewmend.utils.weight_files import MismatchedWeightsError

KINDS = (CaptureError, MismatchedWeightsError, ProtocolError, RunError, ShardError)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_quoted_is_cut_and_the_next_step_stays(kind):
    said = str(kind("a.json: expected a number, got '" + "x" * 50_000 + "'; correct it there"))
    assert len(said) == MOST_CHARACTERS
    assert said.startswith("a.json: expected a number, got 'xxx") and said.endswith("xxx'; correct it there")
    assert " ... " in said and issubclass(kind, InputError)


def test_a_message_of_the_largest_length_stays():
    assert str(InputError("y" * MOST_CHARACTERS)) == "y" * MOST_CHARACTERS


def test_errors_go_from_process_to_process():
    error = pickle.loads(pickle.dumps(CaptureError("z" * 2000)))
    assert type(error) is CaptureError and len(str(error)) == MOST_CHARACTERS


def test_a_file_is_read_up_to_its_bound(tmp_path):
    (tmp_path / "a.json").write_bytes(b"12345")
    assert bounded_bytes(tmp_path / "a.json", 5) == b"12345"
    with pytest.raises(ValueError, match=r"expected a\.json to have at most 4 bytes, got more"):
        bounded_bytes(tmp_path / "a.json", 4)
