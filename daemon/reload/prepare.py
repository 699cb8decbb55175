"""Prepare new estimators beside the running loop: what is wrong with the new files ends here, the loop never hears of it.

build     estimators from the new files, each network loaded, checked and compared with its runtime
shadow    step them through the ring of cycles, so that they have settled on the inputs that the loop has seen
write     their blocks to `swap` in the request, mode 0600; the loop takes it from there (`daemon/reload/swap.py`)

Started by the supervisor as `python -m jtqd.daemon.reload.prepare` with the request of the loop as its only argument; it
answers with one JSON line, without real-time priority, and below the other processes of the daemon.
"""

from __future__ import annotations

import hashlib
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from jtqd.daemon.config import JointConfig
from jtqd.daemon.loop.process import answer, build_estimators, main
from jtqd.daemon.reload.block_file import encoded
from jtqd.daemon.reload.shadow import Shadow
from jtqd.daemon.shared.ring import RingError
from jtqd.estimator.blocks import blocks_of
from jtqd.estimator.sample import Estimator

_NICE: Final = 10


class Refused(Exception):  # noqa: N818 - a no, not an error
    """The new estimators cannot come into force; the message says why."""


def prepare(request: dict[str, Any]) -> int:
    """Build, shadow, write. Returns the exit status; what is wrong goes to the supervisor."""
    with suppress(OSError):  # whatever the supervisor itself was started with
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.nice(_NICE)
    config, estimators = build_estimators(request)
    for joint, estimator in zip(config.joints, estimators, strict=True):
        _check(joint, estimator)
    shadow = Shadow(Path(request["ring"]), estimators)
    shadow.catch_up()
    objection = shadow.objection()
    if objection is not None:
        raise Refused(objection)
    content = encoded(estimators, shadow.position)
    write(Path(request["swap"]), content)
    digest = hashlib.sha256(content).hexdigest()
    answer(
        prepared=True,
        bytes=len(content),
        sha256=digest,
        cycles=shadow.cycles,
        changes=shadow.changes(),
    )
    return 0


def _check(joint: JointConfig, estimator: Estimator) -> None:
    """Raises Refused for an estimator that is not in its blocks alone."""
    try:
        blocks_of(estimator)
    except ValueError:
        name = "its network" if joint.network is None else str(joint.network.path)
        raise Refused(
            f"joint_{joint.number}: {name}: its graph is none of 'jtq train', so that ONNX Runtime evaluates it: "
            "needs a restart"
        ) from None


def write(path: Path, content: bytes) -> None:
    """Write the file anew, for its owner alone. Raises OSError."""
    path.unlink(missing_ok=True)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    with open(descriptor, "wb") as file:
        file.write(content)


def _main(request: dict[str, Any]) -> int:
    try:
        return prepare(request)
    except (Refused, RingError) as error:
        answer(failed=str(error))
        return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], _main))
