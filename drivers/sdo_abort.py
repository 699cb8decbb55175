"""SDO abort codes (CiA 301, 7.2.4.3.17, table 22)."""

from __future__ import annotations

TOGGLE_NOT_ALTERNATED = 0x0503_0000
PROTOCOL_TIMED_OUT = 0x0504_0000
UNKNOWN_COMMAND = 0x0504_0001
OUT_OF_MEMORY = 0x0504_0005
UNSUPPORTED_ACCESS = 0x0601_0000
READ_OF_WRITE_ONLY = 0x0601_0001
WRITE_OF_READ_ONLY = 0x0601_0002
NO_OBJECT = 0x0602_0000
NOT_MAPPABLE = 0x0604_0041
PDO_TOO_LONG = 0x0604_0042
LENGTH_MISMATCH = 0x0607_0010
LENGTH_TOO_HIGH = 0x0607_0012
LENGTH_TOO_LOW = 0x0607_0013
NO_SUBINDEX = 0x0609_0011
VALUE_RANGE = 0x0609_0030
GENERAL_ERROR = 0x0800_0000
DEVICE_STATE = 0x0800_0022
NO_DATA = 0x0800_0024

MEANING = {
    TOGGLE_NOT_ALTERNATED: "toggle bit not alternated",
    PROTOCOL_TIMED_OUT: "SDO protocol timed out",
    UNKNOWN_COMMAND: "unknown SDO command",
    OUT_OF_MEMORY: "out of memory",
    UNSUPPORTED_ACCESS: "unsupported access to an object",
    READ_OF_WRITE_ONLY: "object is write only",
    WRITE_OF_READ_ONLY: "object is read only",
    NO_OBJECT: "object does not exist",
    NOT_MAPPABLE: "object cannot be mapped",
    PDO_TOO_LONG: "mapped objects exceed the PDO",
    LENGTH_MISMATCH: "length does not match the data type",
    LENGTH_TOO_HIGH: "length too high for the data type",
    LENGTH_TOO_LOW: "length too low for the data type",
    NO_SUBINDEX: "sub-index does not exist",
    VALUE_RANGE: "value out of range",
    GENERAL_ERROR: "general error",
    DEVICE_STATE: "not in the present device state",
    NO_DATA: "no data available",
}


def describe_abort(code: int) -> str:
    """The code in words, with its number: "object is read only (06010002h)"."""
    return f"{MEANING.get(code, 'abort')} ({code:08X}h)"


class SdoAbort(Exception):  # noqa: N818  (CiA 301 calls it an abort; it is a reply as much as an error)
    """A transfer refused with an abort code."""

    def __init__(self, code: int) -> None:
        super().__init__(describe_abort(code))
        self.code = code
