"""Checks of ONNX models and arrays from untrusted files, without the libraries that run them. Pages: protocol.md."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.files.archives import parse_array

_ORT_FORMAT = b"ORTM"  # the mark of ONNX Runtime's own flat-buffer format, at byte 4
_MAX_DEPTH = 64  # of nested messages
_MAX_FIELDS = 500_000  # of all messages of a model together; ours have some hundreds
_MAX_FIELD_NUMBER = 2**29  # the runtime's reader truncates larger ones
# Field numbers of onnx.proto: the fields of each kind of message whose own messages may contain a tensor.
_NESTED = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "function": {7: "node", 11: "attribute"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
    "tensor": {},
}
_EXTERNAL_DATA, _DATA_LOCATION = 13, 14  # of TensorProto

_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5  # protobuf's wire types
# By onnx.proto's TensorProto.DataType.
_FLOATS: dict[int, np.dtype[Any]] = {1: np.dtype("<f4"), 10: np.dtype("<f2"), 11: np.dtype("<f8")}


def has_finite_weights(model: bytes) -> bool:
    """Whether all weights of an ONNX model are finite; True for bytes that are no model.

    The runtime does not report NaN: a rectifier turns it into zero. Field numbers of onnx.proto: ModelProto.graph 7,
    GraphProto.initializer 5, TensorProto.data_type 2 and raw_data 9.
    """
    try:
        return all(
            np.isfinite(array).all()
            for graph in _messages(memoryview(model), 7)
            for tensor in _messages(graph, 5)
            for array in _arrays(tensor)
        )
    except (IndexError, ValueError):
        return True


class UnsafeModelError(ValueError):
    """An ONNX model is unsafe to load; the text follows the model's name."""


def find_fault(model: bytes) -> str:
    """Why an ONNX model is unsafe to load or computes nonsense, a text that follows its name; empty if it is sound.

    Bytes that are no model pass; call `check_self_contained` before running one.
    """
    try:
        check_self_contained(model)
    except UnsafeModelError as error:
        return str(error)
    except ValueError:
        pass
    if _is_empty_graph(model):
        return "is an empty graph"
    return "" if has_finite_weights(model) else "has weights that are NaN or infinite"


def check_self_contained(model: bytes) -> None:
    """`ValueError` unless an ONNX model is one whole protobuf message that refers to no other file.

    Stricter than the runtime's reader, so that both understand the same: no groups, no overlong varints.
    """
    if model[4:8] == _ORT_FORMAT:
        raise ValueError("it is in the runtime's own format, not in ONNX")
    try:
        _check_message(memoryview(model), "model", [_MAX_FIELDS])
    except IndexError as error:
        raise ValueError("not a message") from error


def _is_empty_graph(model: bytes) -> bool:
    """Whether an ONNX model computes nothing: it is empty, or a graph without nodes.

    False for bytes that are no message; the runtime refuses them. GraphProto.node is field 1.
    """
    try:
        return not any(True for graph in _messages(memoryview(model), 7) for _ in _messages(graph, 1))
    except (IndexError, ValueError):
        return False


def read_float_array(data: bytes) -> NDArray[np.float32]:
    """Parse a `.npy` of floats as float32; `ValueError` if it is none."""
    array = parse_array(data)
    if array.dtype.kind != "f":
        raise ValueError("not an array of floats")
    return np.asarray(array, dtype=np.float32)


def _check_message(data: memoryview, kind: str, left: list[int], depth: int = 0) -> None:
    """Check one message and those in it; `left[0]` counts down the fields that may still follow."""
    if depth > _MAX_DEPTH:
        raise UnsafeModelError("is nested too deeply")
    for number, value in _fields(data):
        left[0] -= 1
        if left[0] < 0:
            raise UnsafeModelError(f"has more than {_MAX_FIELDS} fields")
        if kind == "tensor" and (number == _EXTERNAL_DATA or (number == _DATA_LOCATION and value != 0)):
            raise UnsafeModelError("keeps weights in another file, which no graph may read")
        if (inner := _NESTED[kind].get(number)) is not None:
            if not isinstance(value, memoryview):
                raise ValueError("not a message")
            _check_message(value, inner, left, depth + 1)


def _arrays(tensor: memoryview) -> Iterator[NDArray[Any]]:
    values = dict(_fields(tensor))
    kind, raw = values.get(2), values.get(9)
    if isinstance(raw, memoryview) and isinstance(kind, int) and kind in _FLOATS:
        yield np.frombuffer(raw, dtype=_FLOATS[kind])


def _messages(data: memoryview, wanted: int) -> Iterator[memoryview]:
    for number, value in _fields(data):
        if number == wanted and isinstance(value, memoryview):
            yield value


def _fields(data: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    position = 0
    while position < len(data):
        tag, position = _varint(data, position)
        number, kind = tag >> 3, tag & 7
        if not 0 < number < _MAX_FIELD_NUMBER:
            raise ValueError("not a message")
        if kind == _VARINT:
            value, position = _varint(data, position)
            yield number, value
            continue
        if kind == _BYTES:
            size, position = _varint(data, position)
        else:
            size = {_EIGHT: 8, _FOUR: 4}.get(kind, len(data))
        if position + size > len(data):
            raise ValueError("not a message")
        yield number, data[position : position + size]
        position += size


def _varint(data: memoryview, position: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[position]
        value |= (byte & 127) << shift
        position, shift = position + 1, shift + 7
        if byte < 128:
            return value, position
        if shift > 63:
            raise ValueError("not a number")
