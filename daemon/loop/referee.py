"""ONNX Runtime judges the networks of a start in a process of its own, which has ended before the loop begins.

    files -> `jtqd.estimator.network`: load, check, compare native evaluation -> a verdict per network, or why it is refused

A graph of ours then runs natively on the bytes that were judged (their SHA-256 is part of the verdict), and the loop never
loads ONNX Runtime: 40 MB, and a library that may fail with a file it was not made for. For any other graph it does.
"""

from __future__ import annotations

from jtqd.daemon.config import Config
from jtqd.daemon.shared.child_process import Child, ChildError
from jtqd.estimator.onnx_graph import RuntimeCheck

PROGRAM = "jtqd.estimator.network"
_LONGEST_S = 60.0


def judged(config: Config) -> list[RuntimeCheck | str | None]:
    """Return per joint the verdict on its network, or why the network is refused; None: it has none."""
    networks = [joint.network for joint in config.joints]
    if not any(networks):
        return [None] * len(networks)
    child = Child(PROGRAM, name="the check by ONNX Runtime")
    try:
        for each in networks:
            if each is not None:
                child.tell([config.estimator.method, str(each.path), each.sha256])
        return [None if each is None else _verdict(child, str(each.path)) for each in networks]
    finally:
        child.end()


def _verdict(child: Child, path: str) -> RuntimeCheck | str:
    """Return the child's next answer."""
    try:
        answer = child.answer(_LONGEST_S)
    except ChildError as error:
        return f"{path}: {error}"
    return str(answer["refused"]) if "refused" in answer else RuntimeCheck(**answer)
