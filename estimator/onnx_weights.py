"""Weights of ONNX graphs, read from the file: of the project's own what `perceptron` needs, of any whether they may be used.

ONNX Runtime does not give a graph's constants to Python, and the package onnx would cost the daemon 10 MB. Of the protocol
buffers' wire format (protobuf.dev/programming-guides/encoding) and of onnx.proto a few fields are enough.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.perceptron import Perceptron

_DOUBLE: Final = 11
"""TensorProto.DataType of float64."""

_FLOATS: Final = {1: ("<f4", 4), 10: ("<f2", 5), 11: ("<f8", 10), 16: ("<u2", 5)}
"""Of the data types FLOAT, FLOAT16, DOUBLE and BFLOAT16: values in raw_data, and the field that holds them otherwise."""
_EXTERNAL: Final = 1
"""TensorProto.DataLocation: in another file."""

_Message = dict[int, list[bytes | int]]


def read_perceptron(data: bytes) -> Perceptron | None:
    """Return the network of an ONNX file of ours (`Gemm, Tanh, ..., Gemm`, plain or gated), None for any other graph."""
    try:
        return _read(data)
    except (KeyError, IndexError, ValueError, OverflowError, struct.error):
        return None  # ONNX Runtime, which has loaded the file, evaluates it


def fault_of(data: bytes) -> str | None:
    """Return what is wrong with the constants of any ONNX file: not in the file that the hash is of, or not finite.

    Infinity is a weight that saturates a layer unseen. Raises ValueError for bytes that are no protocol buffer.
    """
    try:
        model = _message(data)
        for graph in _all(model, 7):
            if fault := _fault_of_graph(_message(graph)):
                return fault
        for function in _all(model, 25):
            if fault := _fault_of_nodes(_all(_message(function), 7)):
                return fault
    except (IndexError, OverflowError, RecursionError, struct.error) as error:
        raise ValueError(f"no protocol buffer: {error}") from None
    return None


def _fault_of_graph(graph: _Message) -> str | None:
    tensors = [_message(each) for each in _all(graph, 5)]
    for sparse in _all(graph, 15):
        tensors += [_message(each) for each in _all(_message(sparse), 1)]
    return _fault_of_tensors(tensors) or _fault_of_nodes(_all(graph, 1))


def _fault_of_nodes(nodes: list[bytes]) -> str | None:
    """Look into the attributes of nodes: constants, and the graphs of loops and branches."""
    for attribute in (_message(each) for node in nodes for each in _all(_message(node), 5)):
        tensors = [_message(each) for key in (5, 10) for each in _all(attribute, key)]
        for sparse in (each for key in (22, 23) for each in _all(attribute, key)):
            tensors += [_message(each) for each in _all(_message(sparse), 1)]
        if fault := _fault_of_tensors(tensors):
            return fault
        if not np.isfinite(np.frombuffer(b"".join(_all(attribute, 2) + _all(attribute, 7)), "<f4")).all():
            return f"found attribute '{_name(attribute, 1)}' with a value that is not finite"
        for graph in (each for key in (6, 11) for each in _all(attribute, key)):
            if fault := _fault_of_graph(_message(graph)):
                return fault
    return None


def _fault_of_tensors(tensors: list[_Message]) -> str | None:
    for tensor in tensors:
        name = _name(tensor, 8)
        if _EXTERNAL in tensor.get(14, []) or 13 in tensor:
            return (
                f"found weights '{name}' in another file, expected them in this one, which the SHA-256 is of"
            )
        if not _is_finite(tensor):
            return f"found weights '{name}' with a value that is not finite"
    return None


def _is_finite(tensor: _Message) -> bool:
    """Return whether all values of a tensor are finite; those that are no floating-point numbers are."""
    for kind in tensor.get(2, []):
        if kind not in _FLOATS:
            continue
        form, field = _FLOATS[kind]
        values = [np.frombuffer(each, form) for each in _all(tensor, 9)]
        if field != 5:
            values += [np.frombuffer(each, form) for each in _all(tensor, field)]
        else:  # halves, each in an int32
            whole = [
                value
                for each in tensor.get(5, [])
                for value in ([each] if isinstance(each, int) else _varints(each))
            ]
            values.append(np.array(whole, np.uint64).astype("<u2").view(form))
        for each in values:
            numbers = (each.astype(np.uint32) << 16).view(np.float32) if form == "<u2" else each
            if not np.isfinite(numbers).all():
                return False
    return True


def _name(message: _Message, key: int) -> str:
    """Return a name as it may be printed."""
    return b"".join(_all(message, key)).decode("utf-8", "replace").encode("unicode_escape").decode()[:60]


def _read(data: bytes) -> Perceptron | None:
    graph = _message(_bytes(_message(data), 7))
    constants = dict(_constant(_message(each)) for each in _all(graph, 5))
    nodes = [_node(_message(each)) for each in _all(graph, 1)]
    layers: list[tuple[FloatArray, FloatArray]] = []
    value = "x"
    at = 0
    while at < len(nodes) and nodes[at][0] == "Gemm":
        _, inputs, outputs, plain = nodes[at]
        if len(inputs) != 3 or inputs[0] != value or not plain:
            return None
        layers.append((constants[inputs[1]], constants[inputs[2]]))
        value = outputs[0]
        at += 1
        if at < len(nodes) and nodes[at][0] == "Tanh":
            if nodes[at][1] != [value]:
                return None
            value = nodes[at][2][0]
            at += 1
        else:
            break
    if not layers or not Perceptron.fits(layers):
        return None
    answer = _text(_message(_bytes(graph, 12)), 1)
    rest = nodes[at:]
    if not rest:
        return Perceptron(layers) if value == answer and nodes[-1][0] == "Gemm" else None
    return _gated(layers, value, rest, constants, answer)


def _gated(
    layers: list[tuple[FloatArray, FloatArray]],
    gains: str,
    rest: list[tuple[str, list[str], list[str], bool]],
    constants: dict[str, FloatArray],
    answer: str,
) -> Perceptron | None:
    """Return the gated network whose last three nodes are `rest`: the inputs picked, times the gains, summed."""
    if [node[0] for node in rest] != ["MatMul", "Mul", "MatMul"] or not all(node[3] for node in rest):
        return None
    (_, [x, pick], [waves], _), (_, factors, [parts], _), (_, [summed, ones], [out], _) = rest
    if (x, sorted(factors), summed, out) != ("x", sorted((gains, waves)), parts, answer):
        return None
    picked = constants[pick]
    if not (constants[ones] == 1.0).all() or constants[ones].shape != (picked.shape[1], 1):
        return None
    if not (np.isin(picked, (0.0, 1.0)).all() and (picked.sum(axis=0) == 1.0).all()):
        return None
    return Perceptron(layers, [int(each) for each in picked.argmax(axis=0)])


def _node(node: _Message) -> tuple[str, list[str], list[str], bool]:
    """Return operator, inputs, outputs, and whether it is one of the standard without attributes."""
    inputs, outputs = ([str(each, "utf-8") for each in _all(node, key)] for key in (1, 2))
    return _text(node, 4), inputs, outputs, not _all(node, 5) and not any(_all(node, 7))


def _constant(tensor: _Message) -> tuple[str, FloatArray]:
    """Return name and values of an initializer; ValueError unless it is float64 and in the file itself."""
    if tensor.get(2) != [_DOUBLE] or tensor.get(14, [0]) != [0]:
        raise ValueError("not float64 in the file")
    shape: list[int] = []
    for each in tensor.get(1, []):
        shape += [each] if isinstance(each, int) else _varints(each)
    raw = b"".join(_all(tensor, 9)) or b"".join(_all(tensor, 10))
    return _text(tensor, 8), np.frombuffer(raw, "<f8").reshape(shape).astype(np.float64)


def _message(data: bytes) -> _Message:
    """Return the fields of a message by number: integers, and bytes of everything that has a length."""
    found: _Message = {}
    for key, value in _fields(data):
        found.setdefault(key, []).append(value)
    return found


def _fields(data: bytes) -> Iterator[tuple[int, bytes | int]]:
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        kind = key & 7
        if kind == 0:
            value, at = _varint(data, at)
            yield key >> 3, value
            continue
        if kind == 2:
            length, at = _varint(data, at)
        elif kind in (1, 5):
            length = 8 if kind == 1 else 4
        else:
            raise ValueError("no wire type of a protocol buffer")
        if at + length > len(data):
            raise ValueError("cut off")
        yield key >> 3, data[at : at + length]
        at += length


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
        if shift > 63:
            raise ValueError("no varint")


def _varints(data: bytes) -> list[int]:
    values, at = [], 0
    while at < len(data):
        value, at = _varint(data, at)
        values.append(value)
    return values


def _all(message: _Message, key: int) -> list[bytes]:
    return [each for each in message.get(key, []) if isinstance(each, bytes)]


def _bytes(message: _Message, key: int) -> bytes:
    (value,) = _all(message, key)
    return value


def _text(message: _Message, key: int) -> str:
    return str(_bytes(message, key), "utf-8")
