"""Receive the torque estimate of jtqd with python-can and print it (docs/bus.md: estimate PDOs of node 20h).

    jtqd --bus unix:/tmp/bus ...     python examples/receivers/receive_estimate.py --bus unix:/tmp/bus
    jtqd --bus vcan0 ...             python examples/receivers/receive_estimate.py --bus vcan0 --count 10

On SocketCAN nothing of jtqd is needed; the unix bus needs it installed, for its python-can interface. For looking, not
for control: a controller that acts on the torque must read docs/safety.md first. The C and C++ receivers beside this file
check status, SYNC counter and age of every estimate.
"""

from __future__ import annotations

import argparse
import struct
import sys
from typing import NamedTuple

import can

COB_IDS = {0x1A0: (1, 2), 0x2A0: (3, 4)}
"""COB-ID of the estimate PDOs of node 20h, and their joints."""
CONTACT_COB_IDS = {0x3A0: (1, 2), 0x4A0: (3, 4)}
"""Of the contact PDOs, with section `contact` (docs/estimator.md)."""
LAYOUT = struct.Struct("<hhBBBB")  # torque 1, torque 2, sigma 1, sigma 2, status of both, SYNC counter
CONTACT_LAYOUT = struct.Struct("<bbBB")  # torque rate 1, torque rate 2, contact of both, SYNC counter
NO_RATE = -0x80
RATE_UNIT_NM_S = 32.0
CONTACT = {0: "off", 1: "unknown", 2: "none", 3: "positive", 4: "negative"}
"""A controller stops on the last two; only "none" means that there is no contact."""
NO_TORQUE = -0x8000
UNKNOWN_SIGMA = 255
STATUS = {
    0: "off",
    1: "starting",
    2: "valid",
    3: "degraded",
    4: "stale",
    5: "drive_fault",
    6: "standstill",
    15: "invalid",
}


class JointEstimate(NamedTuple):
    """One joint: torque and its standard deviation [Nm], None where the PDO has none; name of the status."""

    torque_nm: float | None
    sigma_nm: float | None
    status: str


def decode(data: bytes) -> tuple[JointEstimate, JointEstimate, int]:
    """Decode the eight bytes: both joints, and the SYNC counter of their inputs. Raises struct.error on another length."""
    torque_1, torque_2, sigma_1, sigma_2, status, sequence = LAYOUT.unpack(data)

    def joint(torque: int, sigma: int, code: int) -> JointEstimate:
        return JointEstimate(
            None if torque == NO_TORQUE else 0.01 * torque,
            None if sigma == UNKNOWN_SIGMA else 0.05 * sigma,
            STATUS.get(code, f"unknown ({code})"),
        )

    return joint(torque_1, sigma_1, status & 0x0F), joint(torque_2, sigma_2, status >> 4), sequence


class JointContact(NamedTuple):
    """One joint: torque rate [Nm/s], None where the PDO has none; name of the contact."""

    rate_nm_s: float | None
    contact: str


def decode_contact(data: bytes) -> tuple[JointContact, JointContact, int]:
    """Decode the four bytes: both joints, and the SYNC counter of their inputs. Raises struct.error on another length."""
    rate_1, rate_2, codes, sequence = CONTACT_LAYOUT.unpack(data)

    def joint(rate: int, code: int) -> JointContact:
        torque_rate = None if rate == NO_RATE else RATE_UNIT_NM_S * rate
        return JointContact(torque_rate, CONTACT.get(code, f"unknown ({code})"))

    return joint(rate_1, codes & 0x0F), joint(rate_2, codes >> 4), sequence


def open_bus(name: str) -> can.BusABC:
    """Open a SocketCAN interface, or the unix bus unix:PATH. Raises can.CanError, OSError."""
    filters = [
        {"can_id": each, "can_mask": 0x7FF, "extended": False} for each in (*COB_IDS, *CONTACT_COB_IDS)
    ]
    if name.startswith("unix:"):
        return can.Bus(interface="jtq_unix", channel=name.removeprefix("unix:"), can_filters=filters)
    return can.Bus(interface="socketcan", channel=name, can_filters=filters)


def line(joint: JointEstimate) -> str:
    """Return one joint as text, e.g. "-7.75 Nm +- 0.20 valid"."""
    torque = "   no torque" if joint.torque_nm is None else f"{joint.torque_nm:9.2f} Nm"
    sigma = "?" if joint.sigma_nm is None else f"{joint.sigma_nm:.2f}"
    return f"{torque} +- {sigma:>5}  {joint.status:<11}"


def contact_line(joint: JointContact) -> str:
    """Return one joint as text, e.g. "positive at 640 Nm/s"."""
    rate = "" if joint.rate_nm_s is None else f" at {joint.rate_nm_s:.0f} Nm/s"
    return f"{joint.contact}{rate}"


def main(arguments: list[str] | None = None) -> int:
    """Print every estimate, and contacts that change; exit status 0 after --count or Ctrl-C, 1 without bus or estimate."""
    parser = argparse.ArgumentParser(
        prog="receive_estimate.py",
        description="Print the torque estimate that jtqd publishes, and contacts where they are watched.",
    )
    parser.add_argument("--bus", required=True, help="can0, vcan0 or unix:PATH")
    parser.add_argument("--count", type=int, default=0, metavar="N", help="end after N estimates")
    parser.add_argument("--timeout", type=float, default=1.0, metavar="S", help="longest pause (default 1)")
    options = parser.parse_args(arguments)
    received = 0
    contacts: dict[int, tuple[str, ...]] = {}
    try:
        with open_bus(options.bus) as bus:
            while not options.count or received < options.count:
                message = bus.recv(options.timeout)
                if message is None:
                    print(f"no estimate on {options.bus} for {options.timeout:g} s", file=sys.stderr)
                    return 1
                touched = CONTACT_COB_IDS.get(message.arbitration_id)
                if touched is not None and message.dlc == CONTACT_LAYOUT.size:
                    *told_contacts, sequence = decode_contact(bytes(message.data))
                    names = tuple(each.contact for each in told_contacts)
                    if names != contacts.get(message.arbitration_id):  # every cycle has one: changes only
                        contacts[message.arbitration_id] = names
                        text = (
                            f"{joint}: {contact_line(each)}"
                            for joint, each in zip(touched, told_contacts, strict=True)
                        )
                        print(f"{sequence:3}  contact {'  '.join(text)}", flush=True)
                    continue
                joints = COB_IDS.get(message.arbitration_id)
                if joints is None or message.dlc != LAYOUT.size:
                    continue
                *estimates, sequence = decode(bytes(message.data))
                texts = (f"{joint}: {line(each)}" for joint, each in zip(joints, estimates, strict=True))
                print(f"{sequence:3}  {'  '.join(texts)}".rstrip(), flush=True)
                received += 1
    except KeyboardInterrupt:
        return 0
    except (can.CanError, OSError) as error:
        print(f"{options.bus}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
