"""`jtq fit arm` on logs of the Panda whose links are not those of its URDF, as jtqd-arm writes them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from jtqd.daemon.arm.alignment import Aligned
from jtqd.daemon.arm.arm_file import load_arm
from jtqd.daemon.arm.estimator import ArmEstimator
from jtqd.daemon.arm.messages import ArmMessages
from jtqd.daemon.arm.model import ArmModel, Payload
from jtqd.daemon.arm.process import ArmLog
from jtqd.daemon.jtq import main
from jtqd.estimator.status import VALID
from jtqd.sysid.arm.identification import FreeMotion, normal_of
from tests.daemon.arm.panda import JOINTS, model_text, moved
from tests.sysid.arm.test_identification import SIGMA, other_links
from validation.arm.arm import TOOL
from validation.arm.arm import Payload as TruePayload

MS = 1_000_000
HEAVY = TruePayload(2.0, (0.01, -0.02, 0.06))


def arm_file(folder: Path) -> Path:
    # as most of others do, it has transmissions, whose joints have no link
    wired = '<transmission name="t"><joint name="panda_joint1"/></transmission></robot>'
    (folder / "panda.urdf").write_text(model_text().replace("</robot>", wired))
    joints = {
        name: {"bus": "can0", "joint": k % 4 + 1, "direction": 1, "zero_rad": 0.0}
        for k, name in enumerate(JOINTS)
    }
    for k, name in enumerate(JOINTS):
        joints[name]["bus"] = f"can{k // 4}"
    path = folder / "arm.yaml"
    path.write_text(yaml.safe_dump({"urdf": "panda.urdf", "tool": TOOL, "joints": joints}))
    return path


def log_of(
    arm: Path,
    name: str,
    seed: int,
    payload: TruePayload,
    *,
    cycles: int = 12000,
    gap: int = 0,
    still: bool = False,
    sigma: float | None = None,
    turn: float = 0.0,
) -> Path:
    """Write free motion as jtqd-arm does; return the log. sigma: of joint 3; turn [rad]: of joint 1 from 6 s on."""
    config = load_arm(arm)
    factors, shifts = other_links()
    motion = moved(cycles, payload=payload, seed=seed, still=still, factors=factors, shifts_m=shifts)
    rng = np.random.default_rng([seed, 81])
    torque = motion.torque_nm + SIGMA * (
        0.3 * rng.normal(size=7) + 0.5 * rng.normal(size=motion.torque_nm.shape)
    )
    model = ArmModel(config.urdf, [*config.file.joints], TOOL)
    messages, log = ArmMessages(model, TOOL, MS), ArmLog(config, arm.parent / name)
    nothing = ArmEstimator(model, 1e-3).step(np.full(7, np.nan), SIGMA, SIGMA)
    status, sigmas = np.full(7, VALID, np.uint8), SIGMA.copy()
    sigmas[2] = SIGMA[2] if sigma is None else sigma
    for k in range(cycles):
        instant = 10**12 + (k + (gap if k > cycles // 2 else 0)) * MS
        position = motion.position_rad[k] + 1e-6 * rng.normal(size=7)
        position[0] += turn * (k >= 6000)
        found = messages.of(
            Aligned(instant, position, torque[k], sigmas, status), nothing, k, 17 * 10**17 + instant
        )
        log.add(found[0], instant)
    log.end()
    (made,) = sorted((arm.parent / name).glob("*.mcap"))
    return made


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Path]]:
    arm = arm_file(tmp_path_factory.mktemp("arm"))
    heavy = [False, True, False]
    return arm, [
        log_of(arm, f"log{k}", k, HEAVY if h else TruePayload(), gap=50 * (k == 2))
        for k, h in enumerate(heavy)
    ]


def test_the_written_arm_explains_held_out_motion(
    logs: tuple[Path, list[Path]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arm, (empty, heavy, other) = logs
    hung = f"{heavy}=2.0,0.01,-0.02,0.06"
    assert (
        main(
            [
                "fit",
                "arm",
                str(arm),
                *map(str, (empty, heavy, other)),
                "--payload",
                hung,
                "--out",
                str(tmp_path),
                "--json",
            ]
        )
        == 0
    )
    found = json.loads(capsys.readouterr().out)
    before, after = np.array(list(found["held_out"].values())).T
    assert after[1] < 0.5 * before[1]
    assert "mass" in found["from_cad"]["panda_joint1"]
    assert len(found["logs"]) == 3
    # the files are read back by jtqd-arm, and their arm moves as the true one
    config = load_arm(tmp_path / "arm.yaml")
    factors, shifts = other_links()
    clean = moved(4000, seed=9, factors=factors, shifts_m=shifts)
    motion = FreeMotion(1e-3, clean.position_rad, clean.torque_nm, np.broadcast_to(SIGMA, (4000, 7)))
    errors = []
    for text in (model_text(), config.urdf):
        model = ArmModel(text, JOINTS, TOOL)
        errors.append(normal_of(model, motion).left_nm(model.inertial()))
    assert errors[1][1] < 0.3 * errors[0][1]
    noise = config.file.noise
    assert noise is not None
    assert set(noise.total) == set(JOINTS)
    assert all(0.0 < each < 1.0 for each in noise.total.values())
    assert "jtq fit arm" in config.urdf
    assert found["logs"][str(heavy)]["sha256"] in config.urdf
    assert config.file.joints["panda_joint2"].bus == "can0"


def test_without_its_payload_a_log_makes_the_arm_worse_and_says_so(
    logs: tuple[Path, list[Path]], tmp_path: Path
) -> None:
    arm, (_, heavy, other) = logs
    assert main(["fit", "arm", str(arm), str(heavy), str(other), "--out", str(tmp_path)]) == 3
    assert (tmp_path / "arm.urdf").exists()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--payload", "none.mcap=1,0,0,0"], ("none.mcap", "expected one of")),
        (["--payload", "{log}=1,0,0"], ("LOG=KG,X,Y,Z",)),
        (["--payload", "{log}=-1,0,0,0"], ("0 to 1000 kg",)),
        (["--payload", "{log}=1e300,0,0,0"], ("0 to 1000 kg",)),
        (["--payload", "{log}=1,0,0,60"], ("2 m",)),
    ],
)
def test_wrong_payloads_are_one_line(
    logs: tuple[Path, list[Path]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    expected: tuple[str, ...],
) -> None:
    arm, (empty, *_) = logs
    filled = [each.format(log=empty) for each in words]
    assert main(["fit", "arm", str(arm), str(empty), *filled, "--out", str(tmp_path / "out")]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert all(each in line for each in expected)


def test_logs_that_do_not_fit_are_one_line(
    logs: tuple[Path, list[Path]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arm, (empty, *_) = logs
    short = log_of(arm, "short", 5, TruePayload(), cycles=3000)
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(empty.read_bytes()[:1000])
    for log, word in ((short, "free motion"), (torn, "torn.mcap"), (tmp_path / "no.mcap", "no.mcap")):
        assert main(["fit", "arm", str(arm), str(log), "--out", str(tmp_path / "out")]) == 1
        line = capsys.readouterr().err
        assert line.startswith("jtq fit arm: ")
        assert line.count("\n") == 1
        assert word in line


def test_payload_of_the_fit_is_not_left_in_the_model(logs: tuple[Path, list[Path]]) -> None:
    model = ArmModel(model_text(), JOINTS, TOOL)
    bare = model.torque(np.full(7, 0.3), np.zeros(7), np.zeros(7))
    model.set_payload(Payload(2.0))
    model.set_payload(Payload())
    assert model.torque(np.full(7, 0.3), np.zeros(7), np.zeros(7)) == pytest.approx(bare)


@pytest.mark.parametrize("options", [{"still": True}, {"sigma": 0.0}, {"sigma": np.inf}, {"sigma": np.nan}])
def test_a_log_that_tells_nothing_is_refused(
    logs: tuple[Path, list[Path]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    options: dict[str, Any],
) -> None:
    log = log_of(logs[0], tmp_path.name, 6, TruePayload(), cycles=6000, **options)
    assert main(["fit", "arm", str(logs[0]), str(log), "--out", str(tmp_path)]) == 1
    assert "no 5 s of motion" in capsys.readouterr().err
    assert not (tmp_path / "arm.urdf").exists()


def test_noise_that_runs_do_not_tell_is_that_before_any_fit(
    logs: tuple[Path, list[Path]], tmp_path: Path
) -> None:
    log = log_of(logs[0], tmp_path.name, 7, TruePayload(), turn=2.0 * np.pi)  # two runs of 6 s
    assert main(["fit", "arm", str(logs[0]), str(log), "--out", str(tmp_path)]) == 0
    noise = load_arm(tmp_path / "arm.yaml").file.noise
    assert noise is not None
    assert set(noise.total.values()) == {1.5}
    assert {*noise.tests.values()} == {(1.5, 1.5, 1.5)}


def test_a_log_does_not_hold_out_itself(
    logs: tuple[Path, list[Path]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arm, (empty, *_) = logs
    twin = tmp_path / "twin.mcap"
    twin.write_bytes(empty.read_bytes())
    assert main(["fit", "arm", str(arm), str(empty), str(twin), "--out", str(tmp_path)]) == 1
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert f"{twin}: found the same log as {empty}" in line


def test_files_of_the_arm_are_not_written_over(
    logs: tuple[Path, list[Path]], capsys: pytest.CaptureFixture[str]
) -> None:
    arm, (empty, *_) = logs
    before = arm.read_bytes()
    assert main(["fit", "arm", str(arm), str(empty), "--out", str(arm.parent)]) == 1
    assert f"found {arm} there" in capsys.readouterr().err
    assert arm.read_bytes() == before


def test_what_always_hangs_at_the_tool_is_not_a_part_of_the_arm(
    logs: tuple[Path, list[Path]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arm, (_, heavy, _) = logs
    content = yaml.safe_load(arm.read_text())
    content["payload"] = {"mass_kg": HEAVY.mass_kg, "centre_m": [*HEAVY.centre_m]}
    with_payload = arm.parent / "payload---.yaml"
    with_payload.write_text(yaml.safe_dump(content))
    hung = f"{heavy}=2.0,0.01,-0.02,0.06"
    masses = []
    for words in ([with_payload, heavy], [arm, heavy, "--payload", hung]):
        assert main(["fit", "arm", *map(str, words), "--out", str(tmp_path)]) == 0
        config = load_arm(tmp_path / "arm.yaml")
        masses.append(ArmModel(config.urdf, JOINTS, TOOL).inertial()[:, 0])
    assert masses[0] == pytest.approx(masses[1], rel=1e-6)
