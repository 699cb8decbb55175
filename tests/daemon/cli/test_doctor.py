"""`jtq doctor`: what it finds on a machine, in a broken configuration, in directories, and after a crash."""

import base64
import hashlib
import json
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from jtqd.daemon.cli import doctor as machine
from jtqd.daemon.cli.checks import FAIL, GOOD, SKIP, WARN
from jtqd.daemon.cli.doctor import check_directories, main
from jtqd.daemon.config import Realtime, load_config
from jtqd.models.files import shipped
from tests.drivers.hub_helpers import until_it_listens

Doctor = Callable[..., tuple[int, dict[str, dict[str, str]]]]


@pytest.fixture
def doctor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Doctor:
    """`jtq doctor --json` in this process: exit status, and item -> finding."""
    (tmp_path / "run").mkdir()
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "run"))
    monkeypatch.setattr("jtqd.daemon.cli.running._SHARED", ())
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)

    def run(*arguments: str) -> tuple[int, dict[str, dict[str, str]]]:
        code = main([*arguments, "--json"])
        content = json.loads(capsys.readouterr().out)
        assert content["schema"] == "jtq.doctor/1"
        worst = {0: GOOD, 3: WARN, 1: FAIL}[code]
        assert content["result"] == worst
        return code, {each["item"]: each for each in content["items"]}

    return run


def level(found: dict[str, dict[str, str]], item: str) -> str:
    return found[item]["level"]


def test_files_and_packages_of_this_installation_are_good(doctor: Doctor, tmp_path: Path) -> None:
    _, found = doctor("--bus", "sim", "--record", str(tmp_path))
    for item in (
        "configuration",
        "bus load",
        "joint 1",
        "joint 2",
        "packages",
        "unfinished logs",
        "shared memory",
    ):
        assert level(found, item) == GOOD, found[item]
    assert level(found, "CAN interface") == SKIP
    assert level(found, "SocketCAN") in (GOOD, SKIP), "the emulated bench needs no CAN"
    assert "loads and runs" in found["joint 1"]["text"]
    assert all(each["hint"] for each in found.values() if each["level"] in (WARN, FAIL)), "what to do"


def test_a_configuration_that_cannot_be_used_is_one_failure_among_the_others(
    doctor: Doctor, tmp_path: Path
) -> None:
    broken = tmp_path / "broken.yaml"
    broken.write_text(shipped("bench.yaml").read_text().replace("bitrate: 1000000", "bitrate: fast"))
    code, found = doctor("--bus", "sim", "--config", str(broken))
    assert (code, level(found, "configuration")) == (1, FAIL)
    assert "key 'bitrate'" in found["configuration"]["text"]
    assert "packages" in found


def test_a_network_that_does_not_load_is_found_before_the_daemon_starts(
    doctor: Doctor, tmp_path: Path
) -> None:
    shutil.copytree(shipped("bench.yaml").parent / "trained", tmp_path / "trained")
    text = shipped("bench_paper.yaml").read_text()
    (tmp_path / "trained" / "joint1.onnx").write_bytes(b"not a network")
    (tmp_path / "bench.yaml").write_text(text)
    _, found = doctor("--bus", "sim", "--config", str(tmp_path / "bench.yaml"))
    assert level(found, "configuration") == FAIL
    assert "sha256 of the network" in found["configuration"]["text"]
    old = text.split("sha256: ")[1].split()[0]
    new = hashlib.sha256(b"not a network").hexdigest()
    (tmp_path / "bench.yaml").write_text(text.replace(old, new))
    _, found = doctor("--bus", "sim", "--config", str(tmp_path / "bench.yaml"))
    assert level(found, "configuration") == GOOD
    assert (level(found, "joint 1"), level(found, "joint 2")) == (FAIL, GOOD)


def test_what_a_crash_has_left(doctor: Doctor, tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    (logs / "jtqd-can0-20260101T000000Z.mcap.active").touch()
    (tmp_path / "run" / "jtqd-0-can0").mkdir()
    _, found = doctor("--bus", "sim", "--record", str(logs))
    assert level(found, "unfinished logs") == WARN
    assert "jtq recover" in found["unfinished logs"]["hint"]
    assert level(found, "killed daemons") == WARN
    assert "jtqd-0-can0" in found["killed daemons"]["text"]


def test_a_directory_that_does_not_exist_yet_and_a_disk_that_is_full(
    doctor: Doctor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, found = doctor("--bus", "sim", "--record", str(tmp_path / "a" / "b"))
    assert "it will be created" in found["log directory"]["text"]
    monkeypatch.setattr("jtqd.daemon.cli.doctor._LOG_FREE", 1 << 60)
    _, found = doctor("--bus", "sim", "--record", str(tmp_path))
    assert level(found, "log directory") == WARN


def as_nobody() -> list[tuple[str, str, str]]:
    """Items of kernel and directories for a user without rights, found in a process of its own."""
    readable, writable = os.pipe()
    child = os.fork()
    if not child:
        try:
            resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
            resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))
            os.setgroups([])
            os.setgid(65534)
            os.setuid(65534)
            found = [
                *machine.check_kernel(Realtime(80, None, True), can=False),
                *check_directories(Path("/root/logs"), [Path("/dev/shm")]),
            ]
            os.write(writable, json.dumps([(each.item, each.level, each.text) for each in found]).encode())
        finally:
            os._exit(0)
    os.close(writable)
    with os.fdopen(readable) as file:
        text = file.read()
    os.waitpid(child, 0)
    return [tuple(each) for each in json.loads(text)]


@pytest.mark.skipif(os.geteuid() != 0, reason="becomes another user, which only root can")
def test_rights_are_those_of_the_user_who_asks() -> None:
    found = {item: (level, text) for item, level, text in as_nobody()}
    assert found["SCHED_FIFO"][0] == FAIL
    assert "RLIMIT_RTPRIO 0" in found["SCHED_FIFO"][1]
    assert found["locked memory"][0] == FAIL
    assert found["log directory"][0] == FAIL
    assert found["shared memory"][0] in (GOOD, WARN)


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[str]:
    bus = f"unix:{tmp_path / 'bus'}"
    process = subprocess.Popen([sys.executable, "-m", "jtqd.drivers.hub", bus], stderr=subprocess.PIPE)
    until_it_listens(bus, process)
    yield bus
    process.terminate()
    process.communicate(timeout=10)


def test_a_unix_bus_and_none(doctor: Doctor, hub: str) -> None:
    assert level(doctor("--bus", hub)[1], "bus") == GOOD
    assert level(doctor("--bus", "unix:/nowhere/bus")[1], "bus") == FAIL
    code, found = doctor("--bus", "can77")
    assert (code, level(found, "can77")) == (1, FAIL)
    code, found = doctor("--bus", "lo")
    assert (code, found["lo"]["text"]) == (1, "not a CAN interface")


LINK = {
    "linkinfo": {
        "info_kind": "can",
        "info_data": {
            "state": "ERROR-ACTIVE",
            "berr_counter": {"tx": 0, "rx": 0},
            "restart_ms": 100,
            "bittiming": {"bitrate": 1_000_000},
        },
        "info_xstats": {"error_warning": 0, "error_passive": 0, "bus_off": 0},
    }
}
"""As iproute2 prints a controller with `ip -j -d -s link show can0`."""


@pytest.mark.parametrize(
    ("change", "item", "expected"),
    [
        ({}, "can0 wire", GOOD),
        ({"bittiming": {"bitrate": 500_000}}, "can0 wire", FAIL),
        ({"bittiming": {"bitrate": 1_000_001}}, "can0 wire", FAIL),
        ({"restart_ms": 0}, "can0 wire", WARN),
        ({}, "can0 state", GOOD),
        ({"state": "BUS-OFF"}, "can0 state", FAIL),
        ({"state": "ERROR-WARNING"}, "can0 state", WARN),
    ],
)
def test_a_real_controller(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, object], item: str, expected: str
) -> None:
    """No machine here has one: its files under /sys and iproute2's words are laid out as the kernel documents them."""
    can0 = tmp_path / "can0"
    (can0 / "statistics").mkdir(parents=True)
    for name, text in (("type", "280"), ("flags", "0x40041"), ("tx_queue_len", "1000")):
        (can0 / name).write_text(f"{text}\n")
    (can0 / "statistics" / "rx_over_errors").write_text("3\n")
    link = json.loads(json.dumps(LINK))
    link["linkinfo"]["info_data"] |= change
    monkeypatch.setattr(machine, "_NET", tmp_path)
    monkeypatch.setattr(machine, "link_of", lambda name: link)
    found = {each.item: each.level for each in machine.check_can("can0", load_config(None))}
    assert found[item] == expected
    assert found["can0"] == GOOD
    assert found["can0 drops"] == WARN


def test_cpu_lists_and_a_cpu_that_is_not_there() -> None:
    assert machine._cpus("0-2,5") == {0, 1, 2, 5}
    assert machine._cpus("") == set()
    assert machine._cpu(Realtime(80, 4000, True)).level == FAIL
    assert machine._priority(Realtime(0, None, True)).level == WARN


@pytest.mark.parametrize(
    ("requirement", "level"),
    [
        ("numpy>=1.26", GOOD),
        ('nowhere>=1; extra == "x"', GOOD),
        ("nowhere", FAIL),
        ("numpy>=99", FAIL),
        ("numpy<1.2.3", FAIL),
    ],
)
def test_requirements(requirement: str, level: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "requires", lambda name: [requirement])
    assert machine._packages().level == level


def environment(tmp_path: Path) -> tuple[Path, Path]:
    """An environment as pip leaves it, with jtqd and a library; its site-packages and the module of `jtq doctor`."""
    site = tmp_path / "venv" / "lib" / "site-packages"
    content = {
        "jtqd-0.2.0": {
            "jtqd/daemon/cli/doctor.py": b"own",
            "jtqd/__init__.py": b"",
            "../../bin/jtq": b"script",
        },
        "library-1.0": {"library/core.so": b"compiled", "../../share/man/library.1": b"page"},
    }
    for name, files in content.items():
        rows = [f"{name}.dist-info/RECORD,,", "jtqd/__pycache__/x.pyc,,"]
        for place, data in files.items():
            path = site / place
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
            digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
            rows.append(f"{place},sha256={digest},{len(data)}")
        (site / f"{name}.dist-info").mkdir()
        (site / f"{name}.dist-info" / "METADATA").write_text(f"Name: {name.partition('-')[0]}\nVersion: 1\n")
        (site / f"{name}.dist-info" / "RECORD").write_text("\n".join(rows))
    return site, site / "jtqd" / "daemon" / "cli" / "doctor.py"


def test_installed_files_are_compared_with_what_pip_recorded(tmp_path: Path) -> None:
    site, own = environment(tmp_path)
    found = machine._installed_files(own)
    assert (found.level, found.text) == (GOOD, "5 as installed")
    (
        site / "../../share/man/library.1"
    ).unlink()  # of `pip install --target`: what is no module, lies elsewhere
    assert machine._installed_files(own).level == GOOD
    (site / "library" / "core.so").write_bytes(b"Compiled")
    (site / "jtqd" / "__init__.py").unlink()
    (site / "../../bin/jtq").write_bytes(b"")
    found = machine._installed_files(own)
    assert found.level == FAIL
    assert found.text.startswith("3 of 4 are not as installed: ")
    for text in ("library/core.so differs", "jtqd/__init__.py is missing", "bin/jtq differs"):
        assert text in found.text
    (site / "library" / "core.so").unlink()
    os.mkfifo(site / "library" / "core.so")  # is not waited for
    assert "core.so differs" in machine._installed_files(own).text


def test_installed_files_of_the_debian_package_are_compared_with_its_sums(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site, own = environment(tmp_path)
    byte_code = site / "jtqd" / "a b.pyc"
    byte_code.write_bytes(b"code")
    sums = tmp_path / "jtqd.md5sums"
    lines = [f"{hashlib.md5(path.read_bytes()).hexdigest()}  {str(path)[1:]}" for path in (own, byte_code)]
    edited = "0" * 32 + "  etc/jtqd/bench.yaml"
    sums.write_text("\n".join([*lines, edited]) + "\n")
    monkeypatch.setattr(machine, "_MD5SUMS", sums)
    assert machine._installed_files(own).text == "2 as installed"
    byte_code.write_bytes(b"other")
    found = machine._installed_files(own)
    assert (found.level, found.text) == (FAIL, f"1 of 2 are not as installed: {byte_code} differs")
    sums.write_text(lines[1] + "\n")  # the package is there, and another installation runs
    assert machine._installed_files(own).text == "5 as installed"


def test_a_source_tree_and_an_editable_install_have_no_hashes(tmp_path: Path, doctor: Doctor) -> None:
    site, own = environment(tmp_path)
    elsewhere = tmp_path / "tree" / "src" / "jtqd" / "daemon" / "cli" / "doctor.py"
    assert machine._installed_files(elsewhere).level == SKIP
    record = site / "jtqd-0.2.0.dist-info" / "RECORD"
    record.write_text("__editable__.jtqd-0.2.0.pth,sha256=AAAA,3\n")
    assert machine._installed_files(own).level == SKIP
    assert "installed files" in doctor("--bus", "sim")[1]
