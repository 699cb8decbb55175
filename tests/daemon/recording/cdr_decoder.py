"""Decoder of CDR messages by their ros2msg text alone: the independent reader that the recorder is tested against.

Follows the definition of the formats (ROS 2 interface definition, CDR with alignment from the first byte after the
encapsulation header) and shares nothing with the code under test.
"""

import re
import struct

_CODES = {
    "bool": "?",
    "byte": "B",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
_FIELD = re.compile(r"^(?P<type>[\w/]+)(?P<array>\[(?P<count>\d*)\])?\s+(?P<name>[a-z][a-z0-9_]*)$")
_CONSTANT = re.compile(r"^\w+\s+(?P<name>[A-Z][A-Z0-9_]*)\s*=\s*(?P<value>-?\d+)$")


class Definition:
    """A parsed schema: fields of the message and of those nested in it, and its constants."""

    def __init__(self, name, text):
        blocks = re.split(r"^=+\nMSG: (\S+)\n", text, flags=re.M)
        self.types = {None: self._parse(blocks[0])}
        self.types |= {
            nested: self._parse(body) for nested, body in zip(blocks[1::2], blocks[2::2], strict=True)
        }
        self.name = name

    @staticmethod
    def _parse(text):
        fields, constants = [], {}
        for line in text.splitlines():
            bare = line.split("#")[0].strip()
            if not bare:
                continue
            if found := _CONSTANT.match(bare):
                constants[found["name"]] = int(found["value"])
            elif found := _FIELD.match(bare):
                count = (
                    None
                    if found["array"] is None
                    else (int(found["count"]) if found["count"] else "sequence")
                )
                fields.append((found["name"], found["type"], count))
            else:
                raise ValueError(f"not a line of a message definition: {line!r}")
        return fields, constants

    @property
    def constants(self):
        return self.types[None][1]

    def decode(self, payload):
        """The message as nested dicts; every byte must be used up."""
        assert payload[:4] == b"\x00\x01\x00\x00", "plain CDR, little endian"
        reader = _Reader(payload[4:])
        message = self._read(reader, None)
        assert reader.at == len(reader.data), f"{len(reader.data) - reader.at} bytes are left over"
        return message

    def _read(self, reader, type_name):
        message = {}
        for name, kind, count in self.types[type_name][0]:
            if count is None:
                message[name] = self._one(reader, kind)
            else:
                number = reader.number("I") if count == "sequence" else count
                message[name] = [self._one(reader, kind) for _ in range(number)]
        return message

    def _one(self, reader, kind):
        if kind == "string":
            return reader.text()
        return reader.number(_CODES[kind]) if kind in _CODES else self._read(reader, kind)


class _Reader:
    def __init__(self, data):
        self.data = data
        self.at = 0

    def number(self, code):
        size = struct.calcsize("<" + code)
        start = -(-self.at // size) * size
        assert not any(self.data[self.at : start]), "padding is not zero"
        self.at = start + size
        return struct.unpack_from("<" + code, self.data, start)[0]

    def text(self):
        length = self.number("I")
        data = self.data[self.at : self.at + length]
        assert len(data) == length
        assert data.endswith(b"\0")
        self.at += length
        return data[:-1].decode()
