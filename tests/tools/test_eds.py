"""The data sheets against CiA 306, read with configparser alone; then through canopen's reader."""

import configparser
import re

import pytest
from canopen import import_od

from jtqd.daemon.shared.counters import OBJECT_2200
from tests.paths import EDS
from tools.eds import SHEETS, U8, Var, drive, jtqd_node, render

FILES = ("drive.eds", "torque_sensor.eds", "jtqd.eds")
TYPES = {0x02: 8, 0x03: 16, 0x04: 32, 0x05: 8, 0x06: 16, 0x07: 32, 0x08: 32, 0x09: 0}
SIGNED = (0x02, 0x03, 0x04)
ACCESS = ("ro", "wo", "rw", "rwr", "rww", "const")
DEVICE_INFO = {
    "VendorName",
    "VendorNumber",
    "ProductName",
    "ProductNumber",
    "RevisionNumber",
    "OrderCode",
    "SimpleBootUpMaster",
    "SimpleBootUpSlave",
    "Granularity",
    "DynamicChannelsSupported",
    "GroupMessaging",
    "NrOfRXPDO",
    "NrOfTXPDO",
    "LSS_Supported",
    "BaudRate_10",
    "BaudRate_20",
    "BaudRate_50",
    "BaudRate_125",
    "BaudRate_250",
    "BaudRate_500",
    "BaudRate_800",
    "BaudRate_1000",
}
FILE_INFO = {
    "FileName",
    "FileVersion",
    "FileRevision",
    "EDSVersion",
    "Description",
    "CreationTime",
    "CreationDate",
    "CreatedBy",
    "ModificationTime",
    "ModificationDate",
    "ModifiedBy",
}


def parse(text):
    parser = configparser.RawConfigParser(strict=True)
    parser.optionxform = str
    parser.read_string(text)
    return parser


@pytest.fixture(params=FILES)
def eds(request):
    return parse((EDS / request.param).read_text(encoding="ascii"))


def lists(eds):
    names = ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects")
    return {name: [int(v, 16) for k, v in eds[name].items() if k != "SupportedObjects"] for name in names}


def objects(eds):
    """Every described variable: (index, subindex) -> section."""
    found = {}
    for name in eds.sections():
        if match := re.fullmatch(r"([0-9A-F]{4})(?:sub([0-9A-F]+))?", name):
            if match[2] is None and eds[name]["ObjectType"] in ("0x8", "0x9"):
                continue
            found[int(match[1], 16), int(match[2] or "0", 16)] = eds[name]
    return found


def number(text, node=0x11):
    plain = text.replace(" ", "")
    return int(plain.replace("$NODEID+", ""), 0) + (node if "$NODEID" in plain else 0)


def check(eds):
    """Raises AssertionError at the first breach of CiA 306."""
    assert set(eds["FileInfo"]) >= FILE_INFO
    assert re.fullmatch(r"\d\d:\d\d(AM|PM)", eds["FileInfo"]["CreationTime"])
    assert re.fullmatch(r"\d\d-\d\d-\d{4}", eds["FileInfo"]["CreationDate"])
    assert set(eds["DeviceInfo"]) >= DEVICE_INFO
    assert [f"Dummy{n:04d}" for n in range(1, 8)] == list(eds["DummyUsage"])
    comments = eds["Comments"]
    assert list(comments) == ["Lines", *(f"Line{n}" for n in range(1, int(comments["Lines"]) + 1))]
    grouped = lists(eds)
    for name, indices in grouped.items():
        assert int(eds[name]["SupportedObjects"]) == len(indices), name
        assert [k for k in eds[name] if k != "SupportedObjects"] == [str(n + 1) for n in range(len(indices))]
        assert indices == sorted(set(indices)), name
    assert grouped["MandatoryObjects"] == [0x1000, 0x1001, 0x1018]
    assert all(0x2000 <= index <= 0x5FFF for index in grouped["ManufacturerObjects"])
    assert not any(0x2000 <= index <= 0x5FFF for index in grouped["OptionalObjects"])
    listed = {index for indices in grouped.values() for index in indices}
    described = {int(name, 16) for name in eds.sections() if re.fullmatch(r"[0-9A-F]{4}", name)}
    assert listed == described
    for index in listed:
        check_object(eds, index)
    for (index, _), section in objects(eds).items():
        check_variable(section, index)
    rpdos = sum(0x1400 <= index <= 0x15FF for index in listed)
    tpdos = sum(0x1800 <= index <= 0x19FF for index in listed)
    assert (int(eds["DeviceInfo"]["NrOfRXPDO"]), int(eds["DeviceInfo"]["NrOfTXPDO"])) == (rpdos, tpdos)
    for parameter, base in ((0x1400, 0x200), (0x1800, 0x200)):
        for index in (i for i in listed if parameter <= i < parameter + 0x200):
            assert index + base in listed, f"{index:04X}h has no mapping"
            check_mapping(eds, index + base)


def check_object(eds, index):
    section = eds[f"{index:04X}"]
    kind = int(section["ObjectType"], 16)
    assert kind in (7, 8, 9)
    subindices = sorted(
        int(m[1], 16) for s in eds.sections() if (m := re.fullmatch(rf"{index:04X}sub([0-9A-F]+)", s))
    )
    if kind == 7:
        assert not subindices
        return
    assert int(section["SubNumber"], 0) == len(subindices), f"{index:04X}"
    assert subindices[0] == 0
    first = eds[f"{index:04X}sub0"]
    assert first["DataType"] == "0x0005"
    counts_entries = index == 0x1003 or 0x1600 <= index < 0x1800 or 0x1A00 <= index < 0x1C00
    if counts_entries:
        assert 0 <= int(first["DefaultValue"], 0) <= subindices[-1]
    else:
        assert int(first["DefaultValue"], 0) == subindices[-1], f"{index:04X}"
        assert first["AccessType"] in ("ro", "const")
    if kind == 8:
        assert subindices == list(range(len(subindices)))
        assert len({eds[f"{index:04X}sub{n:X}"]["DataType"] for n in subindices[1:]}) == 1


def check_variable(section, index):
    assert section["ParameterName"]
    assert section["ObjectType"] == "0x7"
    kind = int(section["DataType"], 16)
    assert kind in TYPES, section.name
    assert section["AccessType"] in ACCESS
    assert section["PDOMapping"] in ("0", "1")
    if section["AccessType"] in ("rwr", "rww") or index < 0x1000:
        assert section["PDOMapping"] == "1"
    if kind in (0x08, 0x09):
        assert "LowLimit" not in section
        return
    bits = TYPES[kind]
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if kind in SIGNED else (0, 2**bits - 1)
    floor = number(section.get("LowLimit", str(low)))
    ceiling = number(section.get("HighLimit", str(high)))
    assert low <= floor <= ceiling <= high, section.name
    if "DefaultValue" in section:
        assert floor <= number(section["DefaultValue"]) <= ceiling, section.name


def check_mapping(eds, index):
    every = objects(eds)
    count = int(eds[f"{index:04X}sub0"]["DefaultValue"], 0)
    bits = 0
    for entry in range(1, count + 1):
        word = number(eds[f"{index:04X}sub{entry:X}"]["DefaultValue"])
        mapped = every[word >> 16, word >> 8 & 0xFF]
        assert mapped["PDOMapping"] == "1", mapped.name
        assert TYPES[int(mapped["DataType"], 16)] == word & 0xFF, mapped.name
        assert mapped["AccessType"] in (("ro", "rw", "rwr") if index >= 0x1A00 else ("wo", "rw", "rww"))
        bits += word & 0xFF
    assert bits <= 64


def test_every_file_keeps_cia_306(eds):
    check(eds)


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        ("OptionalObjects", "SupportedObjects", "3"),
        ("1018sub0", "DefaultValue", "3"),
        ("608F", "SubNumber", "2"),
        ("6064", "PDOMapping", "0"),
        ("60C2sub2", "DefaultValue", "-200"),
        ("1A01sub1", "DefaultValue", "0x60640010"),
        ("DeviceInfo", "NrOfTXPDO", "2"),
        ("6040", "AccessType", "readwrite"),
        ("6078", "DataType", "0x00FF"),
    ],
)
def test_the_lint_sees_each_breach(section, key, value):
    broken = parse((EDS / "drive.eds").read_text())
    broken[section][key] = value
    with pytest.raises((AssertionError, KeyError)):
        check(broken)


@pytest.mark.parametrize("make", SHEETS)
def test_files_are_what_the_tables_say(make):
    sheet = make()
    assert (EDS / sheet.file_name).read_text(encoding="ascii") == render(sheet)


def test_identity_is_the_same_in_both_places(eds):
    values = [number(eds[f"1018sub{n}"]["DefaultValue"]) for n in (1, 2, 3)]
    info = [int(eds["DeviceInfo"][key], 0) for key in ("VendorNumber", "ProductNumber", "RevisionNumber")]
    assert values == info


def test_cob_ids_follow_the_predefined_connection_set(eds):
    bases = {0x1400: 0x200, 0x1401: 0x300, 0x1800: 0x180, 0x1801: 0x280, 0x1802: 0x380, 0x1200: 0x600}
    for index, base in bases.items():
        if f"{index:04X}sub1" in eds:
            text = eds[f"{index:04X}sub1"]["DefaultValue"]
            assert text.startswith("$NODEID+0x")
            assert number(text, node=7) & 0x7FF == base + 7


@pytest.mark.parametrize("name", FILES)
def test_canopen_reads_them(name):
    dictionary = import_od(str(EDS / name), 0x20)
    assert dictionary[0x1018].subindices[4].data_type == 7
    assert dictionary[0x1014].default == 0xA0
    assert dictionary[0x1800][1].default == 0x400001A0
    assert dictionary.device_information.allowed_baudrates == {1_000_000}


# index, data type, access, mappable: CiA 402 objects that jtqd and the bench use
DRIVE_OBJECTS = """
603F 6 ro 1    6040 6 rww 1   6041 6 ro 1    6060 2 rww 1   6061 2 ro 1   6064 4 ro 1   606C 4 ro 1
6071 3 rww 1   6075 7 rw 0    6076 7 rw 0    6077 3 ro 1    6078 3 ro 1   60FF 4 rww 1  6502 7 ro 0
608Fsub1 7 ro 0  608Fsub2 7 ro 0  6090sub1 7 ro 0  6090sub2 7 ro 0  6091sub1 7 ro 0  6091sub2 7 ro 0
60E4sub1 4 ro 1  60E6sub1 7 ro 0  60EBsub1 7 ro 0  60C2sub1 5 rw 0  60C2sub2 2 rw 0
"""
SENSOR_OBJECTS = """
6110sub1 6 rw 0  6112sub2 5 rw 0  6114sub1 7 rw 0  6125sub2 7 wo 0  6131sub1 7 rw 0  6132sub2 5 rw 0
6150sub2 5 ro 1  7130sub2 3 ro 1  9130sub1 4 ro 1
"""


@pytest.mark.parametrize(
    ("name", "table"), [("drive.eds", DRIVE_OBJECTS), ("torque_sensor.eds", SENSOR_OBJECTS)]
)
def test_profile_objects_have_the_types_of_the_standard(name, table):
    eds = parse((EDS / name).read_text())
    fields = table.split()
    for section, kind, access, mappable in zip(*[iter(fields)] * 4, strict=True):
        found = eds[section]
        assert (int(found["DataType"], 16), found["AccessType"], found["PDOMapping"]) == (
            int(kind),
            access,
            mappable,
        ), section


def test_device_types_and_modes():
    for name, kind in (("drive", 0x20192), ("torque_sensor", 0x20194), ("jtqd", 0)):
        assert number(parse((EDS / f"{name}.eds").read_text())["1000"]["DefaultValue"]) == kind
    modes = drive().objects[0x6502]
    assert isinstance(modes, Var)
    assert modes.default == 1 << 8 | 1 << 9  # csv, cst
    period = parse((EDS / "drive.eds").read_text())
    assert (period["60C2sub1"]["DefaultValue"], period["60C2sub2"]["DefaultValue"]) == ("1", "-3")  # 1 ms


def test_drive_sends_its_temperature_twice_a_second():
    """TPDO3: 380h+n, event-driven, event timer 500 ms, 3001h alone (I16, 0.1 degC)."""
    eds = parse((EDS / "drive.eds").read_text())
    sub = {n: number(eds[f"1802sub{n}"]["DefaultValue"], node=2) for n in (1, 2, 3, 5, 6)}
    assert sub == {1: 0x4000_0382, 2: 255, 3: 0, 5: 500, 6: 0}
    assert number(eds["1A02sub0"]["DefaultValue"]) == 1
    assert number(eds["1A02sub1"]["DefaultValue"]) == 0x3001_0010
    assert (eds["3001"]["DataType"], eds["3001"]["AccessType"]) == ("0x0003", "ro")
    assert [eds[f"{index}sub5"]["DefaultValue"] for index in ("1800", "1801")] == ["0", "0"]


def test_drive_watches_two_masters_and_the_sensor_one():
    for name, count in (("drive.eds", 2), ("torque_sensor.eds", 1)):
        eds = parse((EDS / name).read_text())
        assert number(eds["1016sub0"]["DefaultValue"]) == count
        assert [eds[f"1016sub{n}"]["AccessType"] for n in range(1, count + 1)] == ["rw"] * count


def test_jtqd_publishes_the_estimate_and_its_counters():
    eds = parse((EDS / "jtqd.eds").read_text())
    words = [number(eds[f"1A00sub{n}"]["DefaultValue"]) for n in range(1, 7)]
    assert words == [0x21000110, 0x21000210, 0x21010108, 0x21010208, 0x21020008, 0x21030008]
    assert [eds[f"2200sub{n:X}"]["ParameterName"] for n in range(1, len(OBJECT_2200) + 1)] == [*OBJECT_2200]
    assert number(eds["1005"]["DefaultValue"]) == 0x40000080  # bit 30: producer
    assert number(eds["1019"]["DefaultValue"]) == 240
    assert jtqd_node().objects[0x2102].data_type == U8
