"""What jtqd refuses at its start: one line, an exit status by which systemd knows whether to try again, nothing sent."""

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from jtqd.drivers.bus_socket import exact
from jtqd.drivers.frame_socket import open_frame_socket
from tests.daemon.test_jtqd import a_bench, configuration, no_traceback, run, runtime, with_joint_1
from tests.estimator.fused_configuration import configured, networks


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    return runtime(tmp_path)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with a_bench(tmp_path_factory.mktemp("bench")) as bus:
        yield bus


def refused(bus: str, config: str, environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    options = ["--bus", bus, "--config", config, "--duration", "1", "--record", "none"]
    return run(*options, environment=environment)


def test_a_network_of_another_method_is_refused_in_one_line(
    tmp_path: Path, environment: dict[str, str]
) -> None:
    config = str(configured(tmp_path, "network", networks()))
    result = run("--bus", "sim", "--config", config, "--record", "none", environment=environment)
    assert result.returncode == 2, "a file is wrong: systemd does not start it again"
    (line,) = (text for text in no_traceback(result).splitlines() if not text.startswith("bench ready"))
    assert line.startswith(
        f"jtqd: {tmp_path}/n1.onnx: found input 'x' of shape ['N', 28], expected ['N', 6] ("
    )


@pytest.mark.parametrize(
    "arguments",
    [[], ["--bus"], ["--bus", 300 * "a"], ["--bus", "sim", "--duration", "-1"], ["--bus", "sim", "--frob"]],
)
def test_usage(arguments: list[str], environment: dict[str, str]) -> None:
    result = run(*arguments, environment=environment)
    assert result.returncode == 2
    no_traceback(result)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"joint_2__node": 9}, ["node 9", "1000h"]),
        ({"joint_1__identity": {"product": 0x1234}}, ["node 1", "1018h:2", "1234"]),
        ({"sensor__node": 2, "joint_2__node": 3}, ["node", "1000h"]),
        ({"estimator__method": "nonsense"}, ["estimator.method", "nonsense"]),
        ({"bitrate": 500_000}, ["bus load", "95"]),
    ],
)
def test_what_does_not_fit_is_named_and_nothing_is_published(
    tmp_path: Path, environment: dict[str, str], bench: str, changes: dict[str, object], words: list[str]
) -> None:
    socket = open_frame_socket(bench, [exact(0x1A0)])
    path = configuration(tmp_path, **changes)
    result = refused(bench, path, environment)
    assert result.returncode == (2 if words[0] in ("estimator.method", "bus load") else 1)
    lines = no_traceback(result).splitlines()
    assert len(lines) == 1, lines
    for word in words:
        assert word in lines[0]
    assert socket.receive() == 0
    socket.close()


def test_a_wrong_gear_ratio_is_refused(tmp_path: Path, environment: dict[str, str], bench: str) -> None:
    path = with_joint_1(tmp_path, {"gear_ratio": 120}, method="efficiency")
    result = refused(bench, path, environment)
    assert result.returncode == 1
    assert "6091h gear ratio: expected 120" in no_traceback(result)
