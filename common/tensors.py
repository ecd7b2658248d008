"""Looking at the arrays in a bundle's parts without the libraries that run them."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5  # protobuf's wire types
# By onnx.proto's TensorProto.DataType.
_FLOATS: dict[int, np.dtype[Any]] = {
    1: np.dtype("<f4"),
    10: np.dtype("<f2"),
    11: np.dtype("<f8"),
}


def weights_finite(model: bytes) -> bool:
    """Whether no weight of an ONNX model is NaN or infinite; what is no model has none.

    The runtime does not tell: a rectifier makes zero of NaN. Field numbers are those of onnx.proto: ModelProto.graph 7,
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


def is_empty(model: bytes) -> bool:
    """Whether an ONNX model computes nothing: it is no bytes at all, or a message without a node.

    What is no message at all is not judged here; the runtime refuses it. GraphProto.node is field 1.
    """
    try:
        return not any(True for graph in _messages(memoryview(model), 7) for _ in _messages(graph, 1))
    except (IndexError, ValueError):
        return False


def read_array(data: bytes) -> NDArray[np.float32]:
    """A `.npy` of floats; `ValueError` if it is none."""
    array = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    if array.dtype.kind != "f":
        raise ValueError("not an array of floats")
    return np.asarray(array, dtype=np.float32)


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
        if not number:
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
