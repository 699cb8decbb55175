"""What went wrong at boot: node, object, expected, found, with the error status letters of CiA 302-2."""

from __future__ import annotations

from drivers.sdo_abort import describe_abort


def label(index: int, subindex: int = 0) -> str:
    """An object as people write it: "1018h:2"."""
    return f"{index:04X}h:{subindex}"


class BootError(Exception):
    """Boot refused. `letter` is "" where CiA 302-2 has none; `str()` is one line that says it all.

    A not in the configuration, B no answer, C device type, D vendor, M product, N revision, O serial number, G no software
    version, H another one, J configuration refused or not taken, K no heartbeat, L was already operational.
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
        text = detail or f"{where}: expected {expected}, found {found}"
        who = "" if node is None else f"node {node}: "
        status = f" (status {letter})" if letter else ""
        super().__init__(f"{who}{text}{status}")

    def report(self) -> dict[str, object]:
        """As JSON-able mapping: node, object, expected, found, letter, message."""
        fields = {"node": self.node, "object": self.object, "expected": self.expected, "found": self.found}
        return {**fields, "letter": self.letter, "message": str(self)}


def mismatch(
    node: int, key: tuple[int, int], name: str, *, expected: str, found: str, letter: str = ""
) -> BootError:
    """An object holds another value than it must."""
    where = label(*key)
    detail = f"{where} {name}: expected {expected}, found {found}"
    return BootError(node, where, expected=expected, found=found, letter=letter, detail=detail)


def no_answer(node: int, key: tuple[int, int], waited_s: float, letter: str) -> BootError:
    """The SDO server is silent."""
    where = label(*key)
    detail = f"no answer to SDO {where} within {waited_s:g} s"
    return BootError(node, where, expected="an answer", found="none", letter=letter, detail=detail)


def refused(node: int, key: tuple[int, int], what: str, code: int, letter: str = "") -> BootError:
    """The SDO server aborted; `what` is "read" or "write of 0x60640020"."""
    where = label(*key)
    found = describe_abort(code)
    detail = f"{where}: {what} refused: {found}"
    return BootError(node, where, expected=f"{what} accepted", found=found, letter=letter, detail=detail)
