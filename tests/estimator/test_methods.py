"""One door to the estimators of all methods: which it gives, and what it refuses to put together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.decoder import decode
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.estimator import FusedEstimator, JointEstimator, estimate_columns, make_estimator
from jtqd.estimator.joint import Effect
from jtqd.estimator.network import Network, PathNetwork, TorqueNetwork, load_network
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import EstimatorSettings, age_ms, recommended
from tests.estimator.estimator_helpers import joint1, small_network
from tests.estimator.fused_helpers import TRACKED, fused_joint, fused_network

FUSED = EstimatorSettings(method="fused")
JOINT = fused_joint()


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(
        ConfigError, match="joint joint1: found no section 'fused', which method 'fused' needs"
    ):
        make_estimator(joint1(), FUSED)
    with pytest.raises(ConfigError, match=r"joint1: found effects \(torque_ripple\)"):
        FusedEstimator(replace(JOINT, effects=(Effect("torque_ripple", {"amplitude_nm": 0.3}),)), FUSED)
    with pytest.raises(
        ConfigError, match="joint1: found method 'tob', which JointEstimator applies, not FusedEstimator"
    ):
        FusedEstimator(JOINT, EstimatorSettings(method="tob"))


def test_networks_of_another_joint_or_kind_are_refused() -> None:
    ours, paper = PathNetwork(fused_network().data), TorqueNetwork(small_network().data)
    table = np.arange(3) * 0.001, JointColumns(*[np.zeros(3)] * 4)
    other = "joint joint9: found a network of joint 'joint1', expected one of 'joint9'"
    for method, network, joint, words in (
        ("fused", ours, replace(JOINT, name="joint9"), other),
        ("fused", paper, JOINT, "joint joint1: found a network of method 'network', expected one of 'fused'"),
        (
            "network",
            ours,
            JOINT,
            "joint joint1: found a network of method 'fused', expected one of 'network'",
        ),
        ("network", paper, replace(JOINT, name="joint9"), other),
    ):
        settings = recommended(method)
        with pytest.raises(ConfigError, match=words):
            make_estimator(joint, settings, network)
        with pytest.raises(ConfigError, match=words):
            estimate_columns(joint, settings, network, *table)


def test_a_network_of_the_current_path_and_a_torsion_have_one_age() -> None:
    """The network has no delay; a torsion through a low pass has one, a joint without torsion none."""
    ours = PathNetwork(fused_network().data)
    older = replace(JOINT, fused=replace(JOINT.fused, tracking=None))  # type: ignore[type-var]
    one = replace(JOINT, fused=replace(JOINT.fused, torsion=None, tracking=None))  # type: ignore[type-var]
    for joint, settings in ((JOINT, FUSED), (older, TRACKED)):
        with pytest.raises(
            ConfigError, match=r"found a network of the current path.*expected estimator\.track_torsion"
        ):
            make_estimator(joint, settings, ours)
    assert make_estimator(one, FUSED, ours).with_network
    assert [age_ms(one, FUSED, network=network) for network in (False, True)] == [5.0, 0.0]
    paper = EstimatorSettings(method="network")
    assert age_ms(one, paper, network=True) == 5.0


def test_a_subclass_of_a_network_is_of_its_method() -> None:
    class Own(TorqueNetwork):
        pass

    class Third(Network):
        features, keys = TorqueNetwork.features, TorqueNetwork.keys

    own, third = Own(small_network().data), Third(small_network().data)
    settings = EstimatorSettings(method="network")
    assert make_estimator(joint1(), settings, own).with_network
    with pytest.raises(ConfigError, match="found a network of method 'network', expected one of 'fused'"):
        make_estimator(JOINT, FUSED, own)
    with pytest.raises(ConfigError, match="found a network of method 'Third', expected one of 'network'"):
        make_estimator(joint1(), settings, third)  # type: ignore[arg-type]


def test_the_door_gives_the_estimator_of_the_method() -> None:
    ours = load_network("fused", fused_network().data)
    paper = load_network("network", small_network().data)
    assert isinstance(ours, PathNetwork)
    assert isinstance(paper, TorqueNetwork)
    assert isinstance(make_estimator(JOINT, FUSED), FusedEstimator)
    assert isinstance(make_estimator(JOINT, TRACKED, ours), FusedEstimator)
    for method, network in (("tob", None), ("efficiency", None), ("network", paper)):
        assert isinstance(make_estimator(JOINT, EstimatorSettings(method=method), network), JointEstimator)


def test_the_papers_estimator_does_not_apply_ours() -> None:
    """Given method `fused` it would quietly be something else."""
    words = "joint joint1: found method 'fused', which FusedEstimator applies"
    with pytest.raises(ConfigError, match=words):
        JointEstimator(JOINT, FUSED)
    with pytest.raises(ConfigError, match=words):
        JointEstimator(JOINT, FUSED, None).run(*[np.full(3, 0.001)] * 5)


def test_settings_are_checked() -> None:
    assert decode(EstimatorSettings, {}, "c.yaml", "estimator") == EstimatorSettings()
    settings = decode(EstimatorSettings, {"method": "tob", "bandwidth_rad_s": 80}, "c.yaml", "e")
    assert (settings.method, settings.bandwidth_rad_s) == ("tob", 80.0)
    for bad in ({"method": "magic"}, {"bandwidth_rad_s": 0}, {"bandwith_rad_s": 80}, {"max_gap_s": np.nan}):
        with pytest.raises(ConfigError, match=r"^c\.yaml: key 'e\."):
            decode(EstimatorSettings, bad, "c.yaml", "e")
    for wrong in ({"method": "x"}, {"sigma_floor": -1.0}, {"torque_limit": np.inf}):
        with pytest.raises(ConfigError):
            EstimatorSettings(**wrong)  # type: ignore[arg-type]
