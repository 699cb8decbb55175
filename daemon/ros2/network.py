"""Where the publisher's DDS domain lies: its number, and the network interface that it uses. Pure.

Cyclone DDS is configured by this XML alone: CYCLONEDDS_URI, which may open other interfaces for other programs, is not read.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence

from jtqd.daemon.config import HIGHEST_DOMAIN, LOOPBACK
from jtqd.estimator.checked import ConfigError

_WHEELS_FOR = "x86_64"
_VARIABLE = "ROS_DOMAIN_ID"
_ANNOUNCED_S = 2.0
"""Between two announcements to the nodes of this machine: for so long a node that is new may have to wait."""


def installed() -> bool:
    """Return whether the package that the publisher needs is installed."""
    return importlib.util.find_spec("cyclonedds") is not None


def needed(machine: str) -> str:
    """Return what is missing and how it is installed, for a machine as `platform.machine` names it."""
    if machine == _WHEELS_FOR:
        return "the package cyclonedds: pip install 'jtqd[ros2]'"
    return (
        f"the package cyclonedds, of which there is no wheel for {machine}: docs/ros2.md says how it is built"
    )


def domain_id(configured: int | None, environment: Mapping[str, str]) -> int:
    """Return the DDS domain: as configured, else as the environment says (ROS_DOMAIN_ID), else 0.

    Raises:
        ConfigError: the environment says something else than a domain.
    """
    text = environment.get(_VARIABLE, "")
    if configured is not None or not text:
        return configured or 0
    if not (text.isascii() and text.isdecimal()) or int(text) > HIGHEST_DOMAIN:
        raise ConfigError(f"{_VARIABLE}: found {text!r}, expected a whole number from 0 to {HIGHEST_DOMAIN}")
    return int(text)


def domain_xml(interface: str, addresses: Sequence[str]) -> str:
    """Return Cyclone DDS's configuration for one network interface.

    Each participant of a machine has a number of its own, and so ports of its own (`auto`), as in ROS 2, so that others find
    it without multicast; 32 is rmw_cyclonedds's limit. On loopback this is how nodes are found that use other interfaces,
    as they do in ROS 2 by default: announcements to this machine's own addresses never leave it. Cyclone DDS 11.0 ignores
    announcements to 127.0.0.1 where it does not use that interface itself (its pull request 2457).

    Args:
        interface: its name.
        addresses: of this machine's interfaces (IPv4).
    """
    discovery = (
        "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
    )
    if interface == LOOPBACK:
        peers = "".join(f'<Peer address="{address}" PruneDelay="inf"/>' for address in addresses)
        discovery += f"<SPDPInterval>{_ANNOUNCED_S:g}s</SPDPInterval><Peers>{peers}</Peers>"
    return (
        '<CycloneDDS><Domain Id="any">'
        f'<General><Interfaces><NetworkInterface name="{interface}"/></Interfaces></General>'
        f"<Discovery>{discovery}</Discovery>"
        "</Domain></CycloneDDS>"
    )
