import pytest

from jtqd.daemon.bus.boot import bus_load_of
from jtqd.daemon.config import load_config
from jtqd.drivers.bus_load import (
    BusLoad,
    BusLoadError,
    Row,
    check_bus_load,
    configured_load,
    heartbeat_row,
    pdo_row,
)
from jtqd.drivers.drive import drive_tpdo1
from jtqd.drivers.own_objects import estimate_tpdos
from jtqd.drivers.pdo import PdoMap
from jtqd.models.files import shipped


def test_the_bench_by_hand():
    """SYNC 55 (65 with a counter byte), four drive PDOs of 135, sensor 105, estimate 135, four heartbeats of 65 in 100."""
    load = configured_load((1, 2), {3: (1,)})
    bits = 55 + 4 * 135 + 105 + 135 + 4 * 65 / 100
    assert load.worst == pytest.approx(bits / 1000)
    assert f"{load.worst:.1%}" == "83.8%"
    counted = configured_load((1, 2), {3: (1,)}, sync_counter=True)
    assert counted.worst - load.worst == pytest.approx(0.010)
    unstuffed = 47 + 4 * 111 + 87 + 111 + 4 * 55 / 100
    assert load.unstuffed == pytest.approx(unstuffed / 1000)
    assert f"{load.unstuffed:.1%}" == "69.1%"
    assert check_bus_load(load) is load


def test_a_temperature_is_a_frame_of_75_bits_in_500_ms():
    without, load = configured_load((1, 2), {}), configured_load((1, 2), {}, temperatures=(2,))
    assert load.worst - without.worst == pytest.approx(75 / 500 / 1000)
    (row,) = (row for row in load.rows if row not in without.rows)
    assert (row.cob_id, row.who, row.length, row.worst_bits * 500) == (0x382, "drive 2 TPDO3", 2, 75)
    slow = configured_load((1, 2), {}, temperatures=(2,), period_s=5e-3)
    assert slow.rows[-1].per_cycle == 0.01


def test_second_channel_fits_and_two_rpdos_do_not():
    load = configured_load((1, 2), {3: (1, 2)})
    assert load.worst == pytest.approx(0.8376 + 0.085)
    check_bus_load(load)
    commands = [Row(0x201, "command 1", 6), Row(0x202, "command 2", 6)]
    full = configured_load((1, 2), {3: (1,)}, extra=commands)
    assert full.worst == pytest.approx(1.0676)
    with pytest.raises(BusLoadError, match=r"bus load 106\.8% in the worst case, expected at most 95%"):
        check_bus_load(full)


def test_the_limit_itself_is_allowed():
    row = Row(0x181, "x", 4)  # 95 bits
    assert check_bus_load(BusLoad((row,), 100_000)).worst == pytest.approx(0.95)
    with pytest.raises(BusLoadError):
        check_bus_load(BusLoad((row,), 99_000))


def test_every_second_sync_counts_half():
    pdo = PdoMap(0x181, drive_tpdo1(1).objects, transmission_type=2)
    assert pdo_row("drive", pdo).worst_bits == pytest.approx(135 / 2)


@pytest.mark.parametrize("kind", [0, 254, 255])
def test_event_driven_pdos_have_no_bound(kind):
    with pytest.raises(BusLoadError, match=f"transmission type {kind} is not bound to SYNC"):
        pdo_row("drive", PdoMap(0x181, drive_tpdo1(1).objects, kind))


def test_duplicate_identifiers_are_named():
    rows = (pdo_row("jtqd", estimate_tpdos(2)[0]), Row(0x1A0, "a foreign node", 1))
    with pytest.raises(BusLoadError, match="COB-ID 1A0h is used twice: jtqd and a foreign node"):
        check_bus_load(BusLoad(rows))


def test_heartbeats_scale_with_their_time_and_the_period():
    assert heartbeat_row("x", 1, 100).per_cycle == pytest.approx(0.01)
    assert heartbeat_row("x", 1, 100, period_s=2e-3).per_cycle == pytest.approx(0.02)
    with pytest.raises(BusLoadError):
        heartbeat_row("x", 1, 0)


def test_table_is_in_the_order_of_priority_and_adds_up():
    load = configured_load((1, 2), {3: (1,)})
    table = load.table()
    assert [row["cob_id"] for row in table][:7] == ["080h", "181h", "182h", "183h", "1A0h", "281h", "282h"]
    assert sum(row["share"] for row in table) == pytest.approx(load.worst)


@pytest.mark.parametrize(("overflow", "length"), [(0, 0), (240, 1)])
def test_a_configuration_without_sync_counter_has_no_counter_byte(tmp_path, overflow, length):
    path = tmp_path / "c.yaml"
    joint = f"{{node: 1, file: '{shipped('joint1.yaml')}'}}"
    path.write_text(
        f"node_id: 32\nsync: {{counter_overflow: {overflow}}}\nestimator: {{method: tob}}\njoint_1: {joint}\n"
    )
    (row,) = (row for row in bus_load_of(load_config(path)).rows if row.cob_id == 0x080)
    assert row.length == length
