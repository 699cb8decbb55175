"""`jtq init --listen`: a configuration of a guest from a bus that is only listened to."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from jtqd.daemon.bus.boot import boot_request
from jtqd.daemon.cli import init
from jtqd.daemon.config import load_config
from jtqd.drivers.boot import Heard, known_nodes
from tests.daemon.bus.test_guest_on_vcan import dcf_of_the_drive

LENGTHS = {0x080: 0, 0x181: 8, 0x281: 8, 0x182: 8, 0x282: 8, 0x183: 5, 0x1A0: 8, 0x720: 1}
VALUES = ["--gear-ratio", "100", "--rated-torque", "40", "--torque-constant", "0.062", "--no-questions"]


def bus(lengths: dict[int, int], period_ns: int = 2_000_300) -> Heard:
    return {cob_id: [(n * period_ns, length) for n in range(50)] for cob_id, length in lengths.items()}


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    """Run the command on a bus where frames of these lengths are heard; returns exit status, output and errors."""
    dcf_of_the_drive(tmp_path / "drive.dcf")

    def run(lengths: dict[int, int], *options: str, dcf: bool = True) -> tuple[int, str, str]:
        monkeypatch.setattr(init, "listen", lambda _bus, _seconds: bus(lengths))
        eds = ["--from-eds", str(tmp_path / "drive.dcf")] if dcf else []
        status = init.main(
            ["--bus", "can0", "--listen", "1", "--out", str(tmp_path / "arm"), *eds, *options, *VALUES]
        )
        said = capsys.readouterr()
        return status, said.out, said.err

    return run


def test_the_drives_are_the_nodes_that_fit_the_dcf(run: Any, tmp_path: Path) -> None:
    status, out, err = run(LENGTHS, "--json")
    assert (status, err) == (0, "")
    notes = json.loads(out)["notes"]
    assert "181h: 8 bytes, 499.9 Hz: TPDO1 of node 1: 6064h:0/32, 60E4h:1/32" in notes
    assert "183h: 5 bytes, 499.9 Hz: TPDO of node 3, not described: another layout than jtqd's own" in notes
    assert "720h: 1 bytes, 499.9 Hz: heartbeat of node 32" in notes
    config = load_config(tmp_path / "arm" / "jtqd.yaml")
    assert (config.role, config.period_ns, [each.node_id for each in config.joints]) == (
        "guest",
        2_000_000,
        [1, 2],
    )
    assert config.node_id == 34, "20h is another node's, 21h the commander's"
    report = known_nodes(boot_request(config, "can0"), bus(LENGTHS))
    assert report["nodes"].keys() == {"1", "2"}
    assert report["nodes"]["1"]["scaling"]["ampere_per_unit"] == pytest.approx(0.008)


@pytest.mark.parametrize(
    "case",
    [
        (LENGTHS, [], False, 2, "the objects in a PDO cannot be heard: give --from-eds with the drives' DCF"),
        (
            {**LENGTHS, 0x181: 6, 0x282: 7},
            [],
            True,
            2,
            "it fits none of the nodes that send PDOs: 1, 2, 3, 32",
        ),
        ({0x181: 8}, [], True, 2, "no SYNC on can0 within 1 s: expected a bus in service, with its master"),
        (LENGTHS, ["--node", "9"], True, 3, "189h: DOES NOT FIT: TPDO1 of node 9 is not heard"),
        ({**LENGTHS, 0x181: 6}, ["--node", "1"], True, 3, "181h: 6 bytes, 499.9 Hz: TPDO1 of node 1"),
    ],
)
def test_what_cannot_be_known(run: Any, case: tuple[Any, ...]) -> None:
    lengths, options, dcf, status, words = case
    found, out, err = run(lengths, *options, dcf=dcf)
    assert found == status
    assert words in out + err
    assert status != 3 or "DOES NOT FIT" in out
    assert (
        dcf or "181h: 8 bytes, 499.9 Hz: TPDO of node 1, not described: as long as jtqd's own layout" in out
    )
