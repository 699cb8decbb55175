"""Where the publisher's DDS domain lies: its number, and the network interface that it uses. Pure.

Cyclone DDS is configured by this XML alone: CYCLONEDDS_URI, which may open other interfaces for other programs, is not read.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping

from jtqd.daemon.config import HIGHEST_DOMAIN, LOOPBACK
from jtqd.estimator.checked import ConfigError

NEEDED = "the package cyclonedds: pip install 'jtqd[ros2]'"
_VARIABLE = "ROS_DOMAIN_ID"
_ON_LOOPBACK = '<Peers><Peer address="127.0.0.1"/></Peers>'
"""Nodes whose discovery range is LOCALHOST (ROS 2 from Iron on) do not listen to multicast."""


def installed() -> bool:
    """Return whether the package that the publisher needs is installed."""
    return importlib.util.find_spec("cyclonedds") is not None


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


def domain_xml(interface: str) -> str:
    """Return Cyclone DDS's configuration for one network interface.

    Each participant of a host has a number of its own, and so ports of its own (`auto`), as in ROS 2: others of the host
    find it without multicast. 32 is what rmw_cyclonedds looks for.
    """
    peers = _ON_LOOPBACK if interface == LOOPBACK else ""
    return (
        '<CycloneDDS><Domain Id="any">'
        f'<General><Interfaces><NetworkInterface name="{interface}"/></Interfaces></General>'
        "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
        f"<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>{peers}</Discovery>"
        "</Domain></CycloneDDS>"
    )
