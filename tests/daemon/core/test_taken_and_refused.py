"""What the compiled classes take and refuse: layouts of PDOs, identifiers, sizes of shared memory."""

from __future__ import annotations

import math
import struct
from array import array
from pathlib import Path
from typing import Any

import pytest

from jtqd.daemon.core.input_pdos import InputPdo, TemperaturePdo
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.joint import JointCycle
from jtqd.daemon.core.record import RecordRing
from jtqd.daemon.core.status import JointRules, JointSafety
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.counters import COUNTERS
from jtqd.daemon.shared.cycle_record import Ring
from jtqd.estimator.estimator import JointEstimator
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import INVALID
from jtqd.models.files import load_joint, shipped
from tests.daemon import ring_records as rr
from tests.daemon.loop.cycle_helpers import I32, SENSOR, frame, inputs, make, turn

PDO = InputPdo(0x181, 8, I32, 1, "181h")
SETTINGS = EstimatorSettings(method="efficiency")


def one(can_id: int, layout: str) -> InputPdo:
    form = struct.Struct(layout)
    return InputPdo(can_id, form.size, form, 1, f"{can_id:03X}h")


@pytest.mark.parametrize(
    ("layout", "values"),
    [
        ("<ii", (-(2**31), 2**31 - 1)),
        ("<ihH", (-5, -(2**15), 2**16 - 1)),
        ("<iB", (7, 255)),
        ("<q", (-(2**63),)),
        ("<bBhHI", (-1, 200, -300, 60_000, 0)),
        ("<I", (2**32 - 1,)),
    ],
)
def test_integers_of_every_width_and_sign(layout: str, values: tuple[int, ...]) -> None:
    form = struct.Struct(layout)
    if form.size > 8:
        form, values = struct.Struct("<bBhH"), values[:4]
    intake = Intake([one(0x181, form.format)])
    intake.begin(1)
    data = form.pack(*values)
    intake.take(bytearray(struct.pack("<IB3x8s", 0x181, form.size, data)), [5], [False], 1)
    assert intake.values(0) == values


@pytest.mark.parametrize("layout", ["<f", "<d", "<4s", "<bbbbbbbbb"])
def test_a_layout_that_cannot_be_decoded_is_refused(layout: str) -> None:
    with pytest.raises(ValueError, match="cannot decode the layout"):
        Intake([one(0x181, layout)])


def test_more_inputs_than_there_is_room_for_are_refused() -> None:
    Intake([one(0x181 + n, "<i") for n in range(20)])
    with pytest.raises(ValueError, match="found 21 inputs, expected at most 20"):
        Intake([one(0x181 + n, "<i") for n in range(21)])
    with pytest.raises(ValueError, match="has more than 11 bits"):
        Intake([one(0x18000, "<i")])
    with pytest.raises(ValueError, match="200 is no node-ID"):
        Intake([PDO], [TemperaturePdo(0x381, 200, "x", 5)])
    with pytest.raises(ValueError, match="128 is no node-ID"):
        Intake([PDO]).configured(128)


def test_a_joint_refuses_a_pdo_with_other_objects(tmp_path: Path) -> None:
    cycle, _, _ = make(tmp_path, lambda n: inputs())
    given = cycle.joints[0].inputs
    intake = Intake([one(0x181, "<i"), *cycle.intake.pdos[1:]])
    with pytest.raises(ValueError, match="found 1 objects, expected 2"):
        JointCycle(0, given, cycle.joints[0].estimator, intake=intake, snapshot=cycle.snapshot, period_ns=1)


def test_counters_of_another_length_are_refused() -> None:
    class Tally:
        counters, errors = array("Q", [0] * (len(COUNTERS) - 1)), array("d", [0.0] * 4)

    with pytest.raises(ValueError, match="not the counters and errors of a snapshot"):
        JointRules(0, Tally(), JointSafety(), False)


def test_a_ring_of_other_records_is_refused(tmp_path: Path) -> None:
    RecordRing(Ring(tmp_path / "ring", 8, rr.RECORD_SIZE))
    with pytest.raises(ValueError, match="found a ring of 512 bytes for 8 cycles"):
        RecordRing(Ring(tmp_path / "other", 8, 64))


def test_an_estimator_that_raises_is_invalid_and_the_loop_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Calling:
        with_network = False

        def __init__(self) -> None:
            self.inner, self.left = JointEstimator(load_joint(shipped("joint1.yaml")), SETTINGS), 30

        def step(self, *sample: float) -> Any:
            self.left -= 1
            if self.left < 0:
                raise ZeroDivisionError
            return self.inner.step(*sample)

    seen: list[Any] = []
    monkeypatch.setattr("sys.unraisablehook", seen.append)
    estimators = [Calling(), JointEstimator(load_joint(shipped("joint2.yaml")), SETTINGS)]
    cycle, _, reader = make(tmp_path, lambda n: inputs(), estimators=estimators)
    turn(cycle, 35)
    assert [joint.status for joint in cycle.joints] == [INVALID, 2]
    assert len(seen) == 5
    joint = cr.joint_of(reader.read(limit=64).records[-1], 1)
    assert math.isnan(joint.torque_nm)


def test_a_sensor_state_beyond_its_field_is_no_reference(tmp_path: Path) -> None:
    cycle, _, reader = make(tmp_path, lambda n: [*inputs()[:4], frame(0x183, SENSOR.pack(5, 255))])
    turn(cycle, 3)
    joint = cr.joint_of(reader.read().records[-1], 1)
    assert (math.isnan(joint.sensor_torque_nm), joint.sensor_status) == (True, 255)
