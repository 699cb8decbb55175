"""Description files of devices (CiA 306) as makers and tools write them: what is odd in them, and what depends on it."""

import random
import re

import pytest

from jtqd.drivers.object_dictionary import EdsError, ObjectStore, read_eds
from jtqd.drivers.survey import survey_of_eds
from tests.drivers.canopen_nodes import EDS

DRIVE = (EDS / "drive.eds").read_text()
UNUSED = "[2010]\nParameterName=Filter\nObjectType=0x7\nDataType=0x0005\nAccessType=rw\nPDOMapping=0\nDefaultValue=3\n"
"""An entry that jtqd has no use for; its DefaultValue stands in the seventh line."""


def section(title):
    """Return a section of the shipped EDS with its line end."""
    return re.search(rf"^\[{title}\]\n(?:[^\[]*\n)", DRIVE, re.MULTILINE)[0].rstrip("\n") + "\n"


def written(tmp_path, *changes, more=""):
    """Write the shipped EDS with changes of its text; each must be one."""
    text = DRIVE
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = tmp_path / "maker.eds"
    path.write_text(text.rstrip("\n") + "\n" + more)
    return path


def entries(path, node=5):
    return {(each.index, each.subindex): each for each in read_eds(path, node).entries}


def value(path, index, subindex=0):
    return ObjectStore(entries(path).values(), 5).number(index, subindex)


ODD = {
    "default beyond its type": (
        "DefaultValue=3",
        "DefaultValue=300",
        "DefaultValue=300, expected a number of 8 bits",
    ),
    "default that is no number": (
        "DefaultValue=3",
        "DefaultValue=off",
        "DefaultValue=off, expected a number",
    ),
    "value in use that is no number": (
        "DefaultValue=3",
        "ParameterValue=abc",
        "ParameterValue=abc, expected a number",
    ),
    "no data type": ("DataType=0x0005\n", "", "no DataType"),
    "data type that is none": ("DataType=0x0005", "DataType=U8", "'U8'"),
    "no access": ("AccessType=rw\n", "", "no AccessType"),
    "mapping that is no number": ("PDOMapping=0", "PDOMapping=maybe", "'maybe'"),
    "two defaults": ("DefaultValue=3", "DefaultValue=3\nDefaultValue=4", "found DefaultValue=4, line"),
    "no equals sign": ("DefaultValue=3", "DefaultValue 3", "found DefaultValue 3, expected KEY=VALUE"),
    "digits that are octal": ("DefaultValue=3", "DefaultValue=010", "DefaultValue=010, expected a number"),
    "members that cannot be counted": (
        "DefaultValue=3",
        "CompactSubObj=many",
        "CompactSubObj=many, expected 1..254",
    ),
    "bytes for a number": ("DefaultValue=3", "DefaultValue=\x07\x1b[31m", "bytes that are no text"),
}


@pytest.mark.parametrize("name", ODD)
def test_an_entry_that_is_not_used_is_a_note_with_section_and_line(tmp_path, name):
    """The line is that of the key, or where the section begins."""
    old, new, words = ODD[name]
    path = written(tmp_path, more=UNUSED.replace(old, new))
    found = survey_of_eds(path, 5)
    (note,) = found.notes
    line, title = re.fullmatch(rf"{re.escape(str(path))}: line (\d+), \[(\w+)\]: .*", note).groups()
    assert title == "2010"
    assert DRIVE.count("\n") < int(line) <= DRIVE.count("\n") + UNUSED.count("\n") + 1
    assert words in note
    assert note.isprintable()
    clean = survey_of_eds(written(tmp_path), 5)
    assert (found.numbers, found.tpdos, found.missing) == (clean.numbers, clean.tpdos, clean.missing)


@pytest.mark.parametrize("name", ODD)
def test_an_entry_that_is_used_is_an_error_with_section_and_line(tmp_path, name):
    """The gear ratio: its default in the place of an unreadable one would be a wrong torque that nobody has been told of."""
    old, new, words = ODD[name]
    parent = "[6091]" if "CompactSubObj" in new else "[6091sub1]"
    entry = UNUSED.replace("[2010]", parent).replace(old, new).replace("expected", "")
    entry = entry.replace("0x0005", "0x0005" if "8 bits" in words else "0x0007")
    path = written(tmp_path, (section("6091sub1"), ""), (section("6091"), ""), more=entry)
    with pytest.raises(EdsError, match=rf": line \d+, {re.escape(parent)}: ") as caught:
        survey_of_eds(path, 5)
    assert words.replace("8 bits", "") in str(caught.value)
    assert str(caught.value).isprintable()
    with pytest.raises(EdsError, match=re.escape(parent)):
        value(path, 0x6091, 1)


def test_a_value_that_only_a_pdo_carries_does_not_matter(tmp_path):
    path = written(tmp_path, (section("6041"), section("6041").replace("DefaultValue=", "DefaultValue=x")))
    if "DefaultValue" not in section("6041"):
        path = written(tmp_path, (section("6041"), section("6041") + "DefaultValue=x\n"))
    assert ["[6041]" in each for each in survey_of_eds(path, 5).notes] == [True]
    path = written(tmp_path, (section("6041"), section("6041").replace("DataType=0x0006\n", "")))
    with pytest.raises(EdsError, match=r"\[6041\]: no DataType"):
        survey_of_eds(path, 5)


def test_a_tpdo_that_cannot_be_read_is_as_if_switched_off(tmp_path):
    path = written(tmp_path, (section("1A02sub1"), section("1A02sub1") + "ParameterValue=abc\n"))
    assert value(path, 0x1A02) == 1, "the entry is in use"
    found = survey_of_eds(path, 5).tpdos
    assert [bool(each.fault) for each in found] == [False, False, True]
    assert not found[2].on
    assert "[1A02sub1]: ParameterValue=abc" in found[2].fault
    without = re.sub(r"AccessType=\w+\n", "", section("1800sub2"))
    one = survey_of_eds(written(tmp_path, (section("1800sub2"), without)), 5).tpdos[0]
    assert "[1800sub2]: no AccessType" in one.fault
    assert not one.type_fixed, "that is not known"


NAMES = {
    "in capitals": lambda text: re.sub(r"^\[.*\]", lambda found: found[0].upper(), text, flags=re.MULTILINE),
    "in small letters": lambda text: re.sub(
        r"^\[.*\]", lambda found: found[0].lower(), text, flags=re.MULTILINE
    ),
    "keys in capitals": lambda text: re.sub(
        r"^\w+=", lambda found: found[0].upper(), text, flags=re.MULTILINE
    ),
    "keys in small letters": lambda text: re.sub(
        r"^\w+=", lambda found: found[0].lower(), text, flags=re.MULTILINE
    ),
    "indented": lambda text: re.sub(r"^(\w+) *= *", r"\t\1 = ", text, flags=re.MULTILINE),
    "with comments": lambda text: re.sub(
        r"^(\w+=.*)", r"; of the maker\n\1 ; as made", text, flags=re.MULTILINE
    ),
    "lines of another system": lambda text: text.replace("\n", "\r\n"),
    "members before their object": lambda text: "\n".join(
        sorted(re.split(r"\n(?=\[)", text), key=lambda each: "sub" not in each[:9])
    ),
    "subindices of two digits": lambda text: re.sub(r"sub([0-9A-Fa-f])\]", r"sub0\1]", text),
}


@pytest.mark.parametrize("name", NAMES)
def test_every_way_to_write_it_describes_the_same_device(tmp_path, name):
    """Names of sections and keys in any case: CiA 306, 4.2."""
    path = tmp_path / "maker.eds"
    path.write_bytes(NAMES[name](DRIVE).encode())
    assert entries(path) == entries(EDS / "drive.eds")
    assert read_eds(path, 5).notes == ()


COMPACT = "ObjectType=0x8\nDataType=0x0007\nAccessType=rw\nPDOMapping=0\n"


@pytest.mark.parametrize(
    ("title", "text", "expected"),
    [
        ("6091", f"{COMPACT}CompactSubObj=2\nDefaultValue=50\n", {0: 2, 1: 50, 2: 50}),
        ("6091", f"{COMPACT}CompactSubObj=0x02\n[6091Value]\nNrOfEntries=2\n1=120\n2=1\n", {1: 120, 2: 1}),
        ("6091", f"{COMPACT}CompactSubObj=2\nDefaultValue=7\n[6091VALUE]\n1=120\n", {1: 120, 2: 7}),
        ("60EB", f"{COMPACT}CompactSubObj=3\nDefaultValue=1\n".replace("0x8", "0x9"), {1: 1, 3: 1}),
        ("6090", f"{COMPACT}CompactSubObj=2\n[6090sub2]\nDataType=7\nAccessType=ro\nDefaultValue=8\n", {1: 0, 2: 8}),
        ("1A00", f"{COMPACT}CompactSubObj=8\n[1A00Value]\n1=0x60640020\n2=0x60E40120\n", {1: 0x60640020, 2: 0x60E40120}),
    ],
)  # fmt: skip
def test_members_that_stand_in_one_section(tmp_path, title, text, expected):
    whole = re.findall(rf"^\[{title}(?:sub\w+)?\]\n(?:[^\[]*\n)", DRIVE, re.MULTILINE)
    path = written(tmp_path, *((each.rstrip("\n") + "\n", "") for each in whole), more=f"[{title}]\n{text}")
    assert {sub: value(path, int(title, 16), sub) for sub in expected} == expected


def test_names_of_members_that_stand_in_one_section(tmp_path):
    more = f"[2011]\nParameterName=Gains\n{COMPACT}CompactSubObj=2\n[2011Name]\nNrOfEntries=1\n2=Integral\n"
    found = entries(written(tmp_path, more=more))
    assert [found[0x2011, sub].name for sub in range(3)] == [
        "Number of entries",
        "Gains: Member 1",
        "Gains: Integral",
    ]


@pytest.mark.parametrize(
    ("data_type", "text", "expected"),
    [
        (2, "0xFD", -3),
        (2, "-3", -3),
        (2, "0x7F", 127),
        (3, "0xFFFD", -3),
        (4, "0xFFFFFFFD", -3),
        (0x15, "0xFFFFFFFFFFFFFFFD", -3),
        (4, "-0x3", -3),
        (2, "0x1FF", None),
        (2, "253", None),
        (5, "0xFD", 253),
        (5, "-3", None),
        (7, "001", 1),
        (7, "00", 0),
        (7, "$NODEID+0x200", 0x205),
        (7, "0x200 + $NodeId", 0x205),
        (7, "", 0),
    ],
)
@pytest.mark.parametrize("key", ["DefaultValue", "ParameterValue"])
def test_numbers_as_they_are_written(tmp_path, key, data_type, text, expected):
    """Negative ones also as their two's complement (hexadecimal); None: they do not fit."""
    more = UNUSED.replace("0x0005", hex(data_type)).replace("DefaultValue=3", f"{key}={text}")
    path = written(tmp_path, more=more)
    if expected is None:
        assert f"{key}={text}, expected a number" in entries(path)[0x2010, 0].fault
        with pytest.raises(EdsError, match=r"\[2010\]"):
            value(path, 0x2010)
    else:
        assert value(path, 0x2010) == expected


@pytest.mark.parametrize(
    ("setup", "node", "bitrate", "notes"),
    [
        ("[DeviceComissioning]\nNodeID=11\nBaudrate=500\n", 11, 500_000, 0),
        ("[DEVICECOMMISSIONING]\nnodeid=0x0B\nbaudrate=125\n", 11, 125_000, 0),
        ("[DeviceComissioning]\nNodeID=0\nBaudrate=\n", None, None, 0),
        ("[DeviceComissioning]\nNodeID=200\nBaudrate=fast\n", None, None, 1),
        ("", None, None, 0),
    ],
)
def test_node_and_bit_rate_of_a_dcf(tmp_path, setup, node, bitrate, notes):
    found = read_eds(written(tmp_path, more=setup), 11)
    assert (found.node, found.bitrate, len(found.notes)) == (node, bitrate, notes)


def test_a_value_in_use_goes_before_a_default_and_another_node_is_told(tmp_path):
    changed = section("6091sub1") + "ParameterValue=120\n"
    path = written(tmp_path, (section("6091sub1"), changed), more="[DeviceComissioning]\nNodeID=11\n")
    found = survey_of_eds(path, 5)
    assert found.numbers[0x6091, 1] == 120
    assert found.source == "values of maker.eds"
    assert found.notes == [f"{path}: of node 11 by its NodeID, read for node 5"]


@pytest.mark.parametrize(
    "content",
    [
        b"\x7fELF\x02\x01\x01\0\0\0[\x1b[31m]\n\x07=\x1b]0;title\x07\n" * 50,
        random.Random(7).randbytes(5000),
        b"PK\x03\x04" + b"\x01\x02" * 300 + b"[Content_Types].xml",
        b"",
        b"not an EDS",
        b"[FileInfo]\nFileName=x.eds\n",
        b"[1000\x1b[2J]\nDataType=7\n",
    ],
)
def test_what_is_no_eds_is_one_line_without_its_bytes(tmp_path, content):
    path = tmp_path / "binary.eds"
    path.write_bytes(content)
    with pytest.raises(EdsError) as caught:
        read_eds(path, 5)
    assert str(caught.value) == f"{path}: found no object in it, expected an EDS or DCF (CiA 306)"


def test_a_damaged_file_has_few_notes(tmp_path):
    path = written(tmp_path, more="".join(f"this is line {n}\n" for n in range(500)))
    notes = read_eds(path, 5).notes
    assert len(notes) == 9
    assert notes[-1].endswith("492 more lines that cannot be read")
