"""`jtq lss`: node-ID and bit rate of a device by the layer setting services (CiA 305), on a bus without a master."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from jtqd.daemon.cli.confirm import NotConfirmed, confirm
from jtqd.daemon.cli.init import node_id
from jtqd.drivers.lss import BIT_RATES, UNCONFIGURED, LssAddress, LssBus, LssDevice, LssFailure

_EXAMPLES = """examples:
  jtq lss inquire --bus can0 --single                            the only device on the bus: identity and node-ID
  jtq lss scan --bus can0                                        find a device without a node-ID (fast scan)
  jtq lss set-node-id 5 --bus can0 --unconfigured --store        and give it one
  jtq lss set-bit-rate 1000000 --bus can0 --identity FB:65520000:1700000:29001321 --store
  jtq lss store --bus can0 --single --yes

A new node-ID holds after NMT reset communication or a power-up, a new bit rate after a power-up; without --store (or store)
both are lost then. The interface must have the bit rate that the device has now. Each write asks first; --yes agrees.

exit status: 0 done, 1 failure, no answer or refused, 2 usage or not confirmed"""


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq lss`."""
    made = argparse.ArgumentParser(
        prog="jtq lss",
        description="Read and set node-ID and bit rate of a device by LSS (CiA 305). A bus with SYNC is refused.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    verbs = made.add_subparsers(dest="verb", required=True, metavar="VERB")
    for verb, text, example in (
        ("inquire", "print identity and node-ID", "--single"),
        ("scan", "find one device without a node-ID", ""),
        ("set-node-id", "set the node-ID", "5 --unconfigured --store"),
        ("set-bit-rate", "set the bit rate", "1000000 --single --store"),
        ("store", "let the device keep node-ID and bit rate", "--single"),
    ):
        one = verbs.add_parser(
            verb, help=text, description=text, epilog=f"example: jtq lss {verb} --bus can0 {example}".rstrip()
        )
        if verb == "set-node-id":
            one.add_argument("value", type=node_id, metavar="N", help="node-ID, 1 to 127")
        if verb == "set-bit-rate":
            rates = ", ".join(map(str, BIT_RATES))
            one.add_argument("value", type=int, choices=BIT_RATES, metavar="B", help=f"bit/s: {rates}")
        one.add_argument("--bus", required=True, help="can0, or unix:PATH")
        if verb != "scan":
            which = one.add_mutually_exclusive_group(required=True)
            which.add_argument(
                "--identity",
                type=_identity,
                metavar="V:P:R:S",
                help="1018h:1 to 4 of the device, hexadecimal",
            )
            which.add_argument("--unconfigured", action="store_true", help="the one that fast scan finds")
            which.add_argument("--single", action="store_true", help="the only device on the bus")
        if verb.startswith("set"):
            one.add_argument("--store", action="store_true", help="and store it")
        if verb not in ("inquire", "scan"):
            one.add_argument("--yes", action="store_true", help="do not ask")
        one.add_argument("--json", action="store_true", help="print as JSON")
    return made


def _identity(text: str) -> LssAddress:
    parts = text.split(":")
    try:
        numbers = [int(part, 16) for part in parts]
    except ValueError:
        numbers = []
    if len(numbers) != 4 or not all(0 <= each <= 0xFFFF_FFFF for each in numbers):
        expected = "vendor:product:revision:serial, four hexadecimal numbers of 32 bits"
        raise argparse.ArgumentTypeError(f"found {text!r}, expected {expected}")
    return LssAddress(*numbers)


def main(argv: list[str]) -> int:
    """Do what is asked; returns the exit status."""
    options = parser().parse_args(argv)
    try:
        with LssBus(options.bus) as bus, _chosen(bus, options) as device:
            return _run(options, device)
    except NotConfirmed as error:
        print(f"jtq lss: {error}", file=sys.stderr)
        return 2
    except LssFailure as error:
        print(f"jtq lss: {error}", file=sys.stderr)
        return 1


@contextmanager
def _chosen(bus: LssBus, options: argparse.Namespace) -> Iterator[LssDevice]:
    if options.verb != "scan" and not options.unconfigured:
        with bus.selected(options.identity) as device:
            yield device
        return
    with bus.unconfigured() as found:
        if found is None:
            raise LssFailure("LSS: no device without a node-ID answers")
        yield found


def _run(options: argparse.Namespace, device: LssDevice) -> int:
    address, node = device.address(), device.node_id()
    where = f"{address}, node-ID {_text(node)}"
    report: dict[str, Any] = {"identity": str(address), "node_id": None if node == UNCONFIGURED else node}
    done = where
    if options.verb == "set-node-id":
        confirm(f"{where}: set node-ID {options.value}{' and store it' * options.store}", options.yes)
        device.set_node_id(options.value)
        done = f"{where}: node-ID {options.value} after NMT reset communication or a power-up"
    elif options.verb == "set-bit-rate":
        confirm(f"{where}: set {options.value} bit/s{' and store it' * options.store}", options.yes)
        device.set_bit_rate(options.value)
        done = f"{where}: {options.value} bit/s after a power-up"
    elif options.verb == "store":
        confirm(f"{where}: store node-ID and bit rate", options.yes)
    stored = options.verb == "store" or getattr(options, "store", False)
    if stored:
        device.store()
        done += ", stored"
    elif options.verb.startswith("set"):
        done += " (not stored)"
    report |= {"stored": stored, "set": getattr(options, "value", None)}
    print(json.dumps(report) if options.json else done)
    return 0


def _text(node: int) -> str:
    return "none" if node == UNCONFIGURED else str(node)
