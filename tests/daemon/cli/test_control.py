"""`jtq control`: what it prints of a reply, and where no daemon takes the order."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from jtqd.daemon.cli import control
from jtqd.daemon.cli.running import NoDaemonError


def answer(monkeypatch: pytest.MonkeyPatch, reply: dict[str, Any] | Exception) -> None:
    def ask(path: Path, request: dict[str, Any], timeout_s: float) -> dict[str, Any]:
        if isinstance(reply, Exception):
            raise reply
        return reply

    daemon = SimpleNamespace(directory=Path("/none"), about=SimpleNamespace(bus="can0"))
    monkeypatch.setattr(control, "choose_daemon", lambda bus: daemon)
    monkeypatch.setattr(control, "ask", ask)


@pytest.mark.parametrize(
    ("verb", "reply", "line"),
    [
        ("ping", {"pid": 7, "cycle": 12, "bus": "can0"}, "jtqd on can0 answers, process 7, cycle 12"),
        ("reset", {"released": "joint 1"}, "jtqd on can0 has released its latched faults: joint 1"),
        ("save", {}, "jtqd on can0 writes the flight recording"),
    ],
)
def test_a_reply_is_one_line(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    verb: str,
    reply: dict[str, Any],
    line: str,
) -> None:
    answer(monkeypatch, {"ok": True, **reply})
    assert control.main([verb]) == 0
    assert capsys.readouterr() == (f"{line}\n", "")
    assert control.main([verb, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"ok": True, **reply}


@pytest.mark.parametrize(
    ("reply", "reason"),
    [
        ({"ok": False, "error": "the gear ratio differs"}, "the gear ratio differs"),
        (FileNotFoundError(), "jtqd accepts no orders now: it is starting or ending"),
        (TimeoutError(), "jtqd did not answer in time"),
        (PermissionError(13, "Permission denied"), "Permission denied"),
        (NoDaemonError("no jtqd runs on this machine", 1), "no jtqd runs on this machine"),
    ],
)
def test_a_refusal_is_one_line_on_standard_error(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    reply: dict[str, Any] | Exception,
    reason: str,
) -> None:
    answer(monkeypatch, reply)
    assert control.main(["reset"]) == 1
    assert capsys.readouterr() == ("", f"jtq control: reset: {reason}\n")
