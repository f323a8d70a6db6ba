"""What is said of input is one short line, whatever the input holds."""

import pickle
from typing import Annotated, Any

import pytest
from msgspec import Meta, Struct

from viewmend.data.errors import CaptureError
from viewmend.live.protocol import ProtocolError
from viewmend.training.run_files import RunError
from viewmend.training.shards import ShardError
from viewmend.utils.untrusted_input import (
    MOST_CHARACTERS,
    MOST_PARTS,
    InputError,
    Number,
    bounded_bytes,
    one_of,
    read_json,
    typed,
)
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


# JSON from outside becomes typed values, or one clear line.


class Wheel(Struct, frozen=True):
    name: str = ""
    radius: Number = 1.0
    teeth: Annotated[int, Meta(ge=3)] = 3

    def __post_init__(self):
        if self.name == "square":
            raise ValueError("expected a round one, got 'square'; turn it")


class Car(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    wheels: Annotated[tuple[Wheel, ...], Meta(min_length=1)]
    colour: Annotated[str, one_of("red", "green")] = "red"
    price: float | None = None


def test_what_fits_is_typed():
    car = typed(read_json('{"wheels": [{"radius": 2, "teeth": 4.0}], "colour": null, "price": null}'), Car)
    assert car == Car(wheels=(Wheel("", 2.0, 4),))
    assert typed({"wheels": [{"teeth": "7", "radius": "2.5"}]}, Car, strict=False).wheels[0] == Wheel(
        "", 2.5, 7
    )


def test_nulls_in_objects_are_absent_and_whole_numbers_are_integers_at_any_depth():
    found: Any = read_json(
        '[null, {"a": null, "b": [{"c": null, "d": 2.0, "e": -1e3}, null], "f": 1e308, "g": 0.5}]'
    )
    assert found == [None, {"b": [{"d": 2, "e": -1000}, None], "f": 1e308, "g": 0.5}]
    assert [type(value) for value in found[1]["b"][0].values()] == [int, int]
    assert type(found[1]["f"]) is float


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{}", "wheels: expected a value, got nothing; add the key"),
        ('{"wheels": null}', "wheels: expected a value, got nothing; add the key"),
        ('{"wheels": []}', "wheels: expected a list that is not empty, got []; look"),
        ("[1]", "expected an object of keys, got [1]; look"),
        ('{"wheels": [{"radius": NaN}]}', "wheels[0]: radius: expected a finite number, got NaN; look"),
        (
            '{"wheels": [{"radius": 1e999}]}',
            "wheels[0]: radius: expected a finite number, got Infinity; look",
        ),
        (
            '{"wheels": [{}, {"name": "w", "teeth": 2}]}',
            "wheel 'w': teeth: expected a whole number >= 3, got 2; look",
        ),
        ('{"wheels": [{"teeth": true}]}', "wheels[0]: teeth: expected a whole number, got true; look"),
        ('{"wheels": [{}], "colour": "red\\n"}', 'colour: expected red or green, got "red\\n"; look'),
        ('{"wheels": [{}], "price": "1"}', 'price: expected a number, got "1"; look'),
        ('{"wheels": [{}], "colours": 1}', "expected keys among wheels, colour, price, got 'colours'; look"),
        ('{"wheels": [{"name": "square"}]}', "wheel 'square': expected a round one, got 'square'; turn it"),
    ],
)
def test_what_does_not_fit_is_one_line(text, message):
    with pytest.raises(ValueError) as refused:
        typed(read_json(text), Car, "look")
    assert str(refused.value) == message


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000, "9" * 9000, b"\xff\xfe\x00\x80"])
def test_what_is_no_json_is_refused(text):
    with pytest.raises(ValueError, match="expected JSON, got something else"):
        read_json(text)


def test_deep_and_long_values_are_cut():
    with pytest.raises(ValueError) as refused:
        typed(read_json('{"wheels": "' + "x" * 5000 + '"}'), Car)
    assert len(str(refused.value)) < 200


def test_numbers_of_any_size_fit_or_are_refused():
    big: Any = read_json(f'{{"radius": {"9" * 400}}}')
    with pytest.raises(ValueError, match="radius: expected another value"):
        typed(big, Wheel)


@pytest.mark.parametrize(
    "text",
    ["[" + "[]," * MOST_PARTS + "0]", b"[" + b'{"a":[]},' * (MOST_PARTS // 2) + b"0]"],
    ids=["text", "bytes"],
)
def test_more_lists_and_objects_than_anything_has_are_refused_unread(text):
    with pytest.raises(
        ValueError, match=f"at most {MOST_PARTS} lists and objects, got {MOST_PARTS + 1}; is it"
    ):
        read_json(text)
    assert len(read_json("[" + "[]," * 1000 + "0]")) == 1001
