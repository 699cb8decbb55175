"""The shipped layouts for Foxglove and Lichtblick: every path and script uses fields of the recorded schemas."""

import json
import re
import types

import pytest

from jtqd.daemon.jtq import main as jtq
from jtqd.daemon.live.layout import layout
from jtqd.daemon.recording import messages
from jtqd.daemon.shared.cycle_record import FLAG_CONTACT, FLAG_CONTACT_KNOWN, MOST_JOINTS
from tests.daemon.live.viewer_log import Topics

_NUMBERS = {"float64", "int32", "int64", "uint8", "uint16", "uint32", "uint64"}
_PANELS = {"Plot", "StateTransitions", "DiagnosticSummary", "RosOut", "RawMessages", "Tab"}
_SCRIPTED = re.compile(r"(/studio_script/\w+)\.(\w+)")


@pytest.fixture(scope="module", params=range(1, MOST_JOINTS + 1))
def joints(request):
    return request.param


@pytest.fixture(scope="module")
def topics(joints):
    return Topics.of_bus(joints)


@pytest.fixture(scope="module")
def shipped(joints):
    return layout(joints=joints)


def scripts(content):
    """Output topic -> (input topic, field -> expression) of the user scripts."""
    found = {}
    for node in content["userNodes"].values():
        assert {*node} == {"name", "sourceCode"}
        source = node["sourceCode"]
        (topic,) = re.findall(r'export const inputs = \["([^"]+)"\]', source)
        (output,) = re.findall(r'export const output = "([^"]+)"', source)
        declared = re.findall(r"(\w+): number", re.search(r"type Output = \{([^}]*)\}", source)[1])
        returned = re.search(r"return \{(.*?)\n  \};", source, re.S)[1]
        fields = dict(re.findall(r"(\w+): (.+?),\n", returned + "\n"))
        assert list(fields) == declared
        assert f'Input<"{topic}">' in source
        found[output] = topic, fields
    return found


def leaves(tree, panels):
    """Identifiers of the panels that a layout shows, those in tabs included."""
    if isinstance(tree, str):
        tabs = panels[tree].get("tabs", [])
        return [tree, *(leaf for tab in tabs for leaf in leaves(tab["layout"], panels))]
    assert tree["direction"] in ("row", "column")
    assert 0 < tree["splitPercentage"] < 100
    return leaves(tree["first"], panels) + leaves(tree["second"], panels)


def test_it_has_the_keys_of_import_from_file_and_shows_every_panel_once(shipped):
    assert {*shipped} == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    shown = leaves(shipped["layout"], shipped["configById"])
    assert sorted(shown) == sorted(shipped["configById"])
    assert {name.split("!")[0] for name in shown} == _PANELS


def test_every_path_selects_a_number(shipped, topics, joints):
    outputs = scripts(shipped)
    paths = [path for panel in shipped["configById"].values() for path in panel.get("paths", [])]
    assert len(paths) > 15 * joints
    for path in paths:
        assert path["timestampMethod"] == "receiveTime"
        if found := _SCRIPTED.fullmatch(path["value"]):
            assert found[2] in outputs[found[1]][1], path
        else:
            assert topics.kind(path["value"]) in _NUMBERS, path


def test_the_other_panels_have_topics_of_the_types_they_take(shipped, topics):
    panels = shipped["configById"]
    names = {topic: definition.name for topic, definition in topics.definitions.items()}
    assert names[panels["DiagnosticSummary!summary"]["topicToRender"]] == messages.DIAGNOSTICS.schema
    assert names[panels["RosOut!log"]["topicToRender"]] == messages.LOG.schema
    assert names[panels["RawMessages!event"]["topicPath"]] == messages.EVENTS.schema


def test_the_scripts_use_fields_that_exist(shipped, topics):
    for output, (topic, _) in scripts(shipped).items():
        assert output.startswith("/studio_script/")
        source = next(n["sourceCode"] for n in shipped["userNodes"].values() if output in n["sourceCode"])
        for field in re.findall(r"message\.(\w+)", source):
            topics.kind(f"{topic}.{'header.stamp.sec' if field == 'header' else field}")


def test_the_scripts_give_band_residual_and_contact(shipped, joints):
    for joint in range(1, joints + 1):
        topic, fields = scripts(shipped)[f"/studio_script/joint_{joint}"]
        assert topic == f"/joint/{joint}/state"
        message = types.SimpleNamespace(torque_nm=5.0, sigma_nm=0.5, reference_nm=4.75)
        numbers = {n: eval(text, {"message": message}) for n, text in fields.items() if n != "contact"}
        assert numbers == {"upper_nm": 5.5, "lower_nm": 4.5, "minus_sigma_nm": -0.5, "residual_nm": 0.25}
        flags = re.fullmatch(
            r"\(message\.input_flags & (\d+)\) === 0 \? NaN : \(message\.input_flags & (\d+)\) === 0 \? 0 : 1",
            fields["contact"],
        )
        assert tuple(map(int, flags.groups())) == (FLAG_CONTACT_KNOWN, FLAG_CONTACT)


def test_viewers_name_status_and_kind_of_event(topics):
    assert topics.names_of_values("/joint/1/state", "status") == messages.STATUS_NAMES
    assert topics.names_of_values("/events", "kind") == {kind.value: kind.name for kind in messages.EventKind}
    assert topics.names_of_values("/joint/1/state", "statusword") == {}


@pytest.mark.parametrize(
    "path",
    [
        "/joint/5/state.torque_nm",
        "/joint/1/state.torque",
        "/joint/1/state.header.stamp.nothing",
        "/joint/1/state.torque_nm.more",
        "/can/frames.frames.id",
        "/can/frames.missed[0]",
        "joint/1/state torque_nm",
    ],
)
def test_the_check_of_paths_refuses_what_is_not_there(path):
    with pytest.raises(ValueError, match=r".+"):
        print(Topics.of_bus(2).kind(path))


def test_the_check_of_paths_knows_arrays_and_filters():
    assert Topics.of_bus(2).kind("/can/frames.frames[:]{id==385}.length") == "uint8"
    assert Topics.of_bus(2).kind("/can/frames.stamps_ns[3]") == "int64"


def test_command(tmp_path, capsys):
    out = tmp_path / "jtqd.layout.json"
    assert jtq(["layout", "--out", str(out)]) == 0
    assert json.loads(out.read_text()) == layout()
    assert not any("followingViewWidth" in panel for panel in layout()["configById"].values())
    assert jtq(["layout", "--follow", "7", "--joints", "3"]) == 0
    panels = json.loads(capsys.readouterr().out)["configById"]
    plots = {name: panel.pop("followingViewWidth") for name, panel in panels.items() if "Plot!" in name}
    assert set(plots.values()) == {7.0}
    assert panels == layout(joints=3)["configById"]
    assert jtq(["layout", "--out", str(tmp_path / "none" / "x.json")]) == 1
    assert capsys.readouterr().err.startswith(f"jtq layout: {tmp_path}/none/x.json: No such file")
