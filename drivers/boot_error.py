"""Why a node, or the bus, cannot be used: node, object, expected, found, and the error status letter of CiA 302-2."""

from __future__ import annotations

from jtqd.drivers.sdo import Key, label


class BootError(Exception):
    """A node refused at boot or while it is set up; `str()` is one line with everything.

    Attributes:
        node: node number; None: the bus as a whole.
        object: "1018h:2", or what else was looked at.
        expected, found: as text; "" where the message has no such pair.
        letter: error status of CiA 302-2; "" where it has none. A not in the configuration, B no answer, C device type,
            D vendor, M product, N revision, O serial number, G no software version, H another one, J configuration refused
            or not taken, K no heartbeat, L was already operational.
    """

    def __init__(
        self,
        node: int | None,
        where: str,
        *,
        expected: str = "",
        found: str = "",
        letter: str = "",
        detail: str = "",
    ) -> None:
        self.node, self.object, self.expected, self.found, self.letter = node, where, expected, found, letter
        self.detail = text = detail or f"{where}: expected {expected}, found {found}"
        who = "" if node is None else f"node {node}: "
        status = f" (status {letter})" if letter else ""
        super().__init__(f"{who}{text}{status}")

    def explained(self, by: str) -> BootError:
        """Return the same error with what the node itself says about it; "" for nothing."""
        fields = {"expected": self.expected, "found": self.found, "letter": self.letter}
        return BootError(self.node, self.object, **fields, detail=f"{self.detail}; {by}") if by else self

    def report(self) -> dict[str, object]:
        """Return it as a JSON-able mapping: node, object, expected, found, letter, message."""
        fields = {"node": self.node, "object": self.object, "expected": self.expected, "found": self.found}
        return {**fields, "letter": self.letter, "message": str(self)}


def mismatch(node: int, key: Key, name: str, *, expected: str, found: str, letter: str = "") -> BootError:
    """Return the error for an object, `name` in words, that holds another value than it must."""
    where = label(*key)
    detail = f"{where} {name}: expected {expected}, found {found}"
    return BootError(node, where, expected=expected, found=found, letter=letter, detail=detail)
