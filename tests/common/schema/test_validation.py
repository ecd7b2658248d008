"""What msgspec checks of documents, and what it leaves open: fields, numbers and texts that only JSON has."""

import subprocess
import sys
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, get_args

import msgspec
import pytest

from dreamfleet.common.protocol.messages import Message
from dreamfleet.common.schema.validation import (
    OPTIONAL,
    SCHEMA,
    Count,
    MalformedError,
    Packed,
    convert,
    from_plain,
    from_plain_lenient,
    to_plain,
)


@dataclass(frozen=True)
class Wheel:
    size: float
    spokes: Count = 36  # required all the same


@dataclass(frozen=True)
class Car:
    name: str
    wheels: Annotated[tuple[Wheel, ...], msgspec.Meta(max_length=4)]
    texts: dict[str, str]
    facts: dict[str, Any]
    kind: Literal["slow", "fast"] | None = None
    load: float = field(default=1.5, metadata=OPTIONAL)


CAR = Car("ä", (Wheel(1.0),), {"de": "Auto"}, {"any": [1, None]})
PLAIN = to_plain(CAR)


def test_a_document_returns_as_it_was_and_an_optional_default_is_not_written_whichever_object_it_is():
    assert from_plain(Car, PLAIN) == from_plain_lenient(Car, PLAIN) == CAR
    assert to_plain(Car(**{**vars(CAR), "load": float("1.5")})) == PLAIN
    assert PLAIN.keys() == {"name", "wheels", "texts", "facts", "kind"}
    assert to_plain(Car(**{**vars(CAR), "load": 2.0}))["load"] == 2.0


@pytest.mark.parametrize(
    "changes",
    [
        {"wheels": [{"size": 1.0}]},  # a default that is not optional
        *({"wheels": [{"size": size, "spokes": 1}]} for size in (float("nan"), float("inf"), 10**400, True)),
        *({"wheels": [{"size": 1, "spokes": spokes}]} for spokes in (True, 2**63)),
        {"wheels": [[1.0, 36]]},
        {"wheels": [{"size": 1, "spokes": 1}] * 5},
        {"name": "\ud800"},
        {"texts": {"de": "\ud800"}},
        {"kind": "odd"},
        {"load": None},
    ],
)
def test_a_document_that_does_not_fit_is_refused(changes):
    for read in (from_plain, from_plain_lenient):
        with pytest.raises(MalformedError) as caught:
            read(Car, {**PLAIN, **changes})
        assert caught.value.reason == SCHEMA


def test_only_the_lenient_reader_takes_unknown_fields_at_any_depth():
    later = {**PLAIN, "horn": 1, "wheels": [{"size": 1.0, "spokes": 36, "tyre": "soft"}]}
    assert from_plain_lenient(Car, later) == CAR
    for plain in (later, {**later, "wheels": PLAIN["wheels"]}, {**PLAIN, "wheels": later["wheels"]}):
        with pytest.raises(MalformedError):
            from_plain(Car, plain)


def test_a_hostile_name_of_a_field_cannot_reach_a_terminal():
    with pytest.raises(MalformedError) as caught:
        from_plain(Car, {**PLAIN, "\x1b[2J" * 1000: 1})
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 1000
    with pytest.raises(MalformedError):  # text never passes for bytes
        convert(bytes, "AQEB")


def _structs(kind: type[Packed]) -> set[type[Packed]]:
    return {kind, *(each for below in kind.__subclasses__() for each in _structs(below))}


def test_msgspec_knows_each_default_of_a_message_again():
    """It leaves out what *is* the default: another object that equals it would be written."""
    found = _structs(Packed)
    assert found > set(Message.__subclasses__())
    for each in (each for kind in found for each in msgspec.structs.fields(kind) if not each.required):
        default = each.default
        is_small = isinstance(default, int) and 0 <= default <= 256
        assert is_small or any(default is known for known in (None, "", b"", (), *get_args(each.type))), each


FIRST_USES = """
import sys
from dataclasses import make_dataclass
from threading import Barrier, Thread
from dreamfleet.common.schema.validation import Packed, convert

def use(kind, together):
    together.wait()
    convert(kind, {"inner": {"one": 1, "two": "2"}, "list": []})

sys.setswitchinterval(1e-6)
for _ in range(100):
    class Inner(Packed, frozen=True):
        one: int
        two: str
        three: tuple[int, ...] = ()
    kind = make_dataclass("Kind", [("inner", Inner), ("list", list[Inner])])
    threads = [Thread(target=use, args=(kind, together)) for together in [Barrier(4)] * 4]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
"""


def test_threads_that_use_a_type_first_at_the_same_time_wait_for_its_description():
    """By itself msgspec reads a half-built one then, which ends the process by a segmentation fault."""
    assert subprocess.run([sys.executable, "-c", FIRST_USES], check=False).returncode == 0
