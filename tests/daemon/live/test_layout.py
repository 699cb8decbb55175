"""The layout for Foxglove and Lichtblick: every path in it exists in a log of the bench."""

import json
import math
import re
import types

import pytest

from jtqd.daemon.jtq import main as jtq
from jtqd.daemon.live.layout import layout
from jtqd.daemon.recording import schemas
from jtqd.daemon.shared.cycle_record import FLAG_CONTACT, FLAG_CONTACT_KNOWN
from tests.daemon.live.viewer_log import Log, bench_log

pytestmark = pytest.mark.native

_NUMBERS = {"float64", "int32", "int64", "uint8", "uint16", "uint32", "uint64"}
_PANELS = {"Plot", "StateTransitions", "DiagnosticSummary", "RosOut", "RawMessages", "Tab"}
_SCRIPTED = re.compile(r"(/studio_script/\w+)\.(\w+)")


@pytest.fixture(scope="module")
def log():
    return Log(bench_log())


@pytest.fixture(scope="module")
def made():
    return json.loads(json.dumps(layout(), allow_nan=False))


def script(source):
    """(input topic, output topic, field -> expression) of a user script."""
    (topic,) = re.findall(r'export const inputs = \["([^"]+)"\]', source)
    (output,) = re.findall(r'export const output = "([^"]+)"', source)
    typed = re.findall(r"(\w+): number", re.search(r"type Output = \{([^}]*)\}", source)[1])
    returned = re.search(r"return \{(.*?)\n  \};", source, re.S)[1]
    fields = dict(re.findall(r"(\w+): (.+?),\n", returned + "\n"))
    assert list(fields) == typed, "what it returns is what it declares"
    assert f'Input<"{topic}">' in source
    return topic, output, fields


def scripted(made):
    return {output: (topic, fields) for topic, output, fields in map(script, sources(made))}


def sources(made):
    return [node["sourceCode"] for node in made["userNodes"].values()]


def leaves(tree, panels):
    """Identifiers of the panels that a layout shows, those in tabs included."""
    if tree is None:
        return []
    if isinstance(tree, str):
        tabs = panels[tree].get("tabs", [])
        return [tree, *(leaf for tab in tabs for leaf in leaves(tab["layout"], panels))]
    assert tree["direction"] in ("row", "column")
    assert 0 < tree["splitPercentage"] < 100
    return leaves(tree["first"], panels) + leaves(tree["second"], panels)


def test_it_is_what_import_from_file_takes(made):
    assert {*made} == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    for key in ("configById", "globalVariables", "userNodes"):
        assert isinstance(made[key], dict)
    assert made["playbackConfig"] == {"speed": 1}
    for node in made["userNodes"].values():
        assert {*node} == {"name", "sourceCode"}


def test_every_panel_is_shown_once_and_is_of_a_known_kind(made):
    shown = leaves(made["layout"], made["configById"])
    assert sorted(shown) == sorted(made["configById"])
    assert {name.split("!")[0] for name in shown} == _PANELS


def test_every_path_selects_a_number_of_a_message_in_the_log(made, log):
    outputs = scripted(made)
    paths = [path for panel in made["configById"].values() for path in panel.get("paths", [])]
    assert len(paths) > 30
    for path in paths:
        assert path["timestampMethod"] == "receiveTime"
        if found := _SCRIPTED.fullmatch(path["value"]):
            assert found[2] in outputs[found[1]][1], path
        else:
            assert log.kind(path["value"]) in _NUMBERS, path


def test_the_other_panels_topics_are_in_the_log_with_the_types_they_take(made, log):
    panels = made["configById"]
    of = {topic.name: topic.schema for topic in schemas.TOPICS}
    assert of[panels["DiagnosticSummary!summary"]["topicToRender"]] == "diagnostic_msgs/msg/DiagnosticArray"
    assert of[panels["RosOut!log"]["topicToRender"]] == "rcl_interfaces/msg/Log"
    assert panels["RawMessages!event"]["topicPath"] == "/events"
    assert {"/diagnostics", "/log", "/events"} <= {*log.messages}


def test_the_scripts_use_fields_that_exist(made, log):
    for source in sources(made):
        topic, output, _ = script(source)
        assert output.startswith("/studio_script/")
        assert topic in log.messages
        for field in re.findall(r"message\.(\w+)", source):
            log.kind(f"{topic}.{field}") if field != "header" else log.kind(f"{topic}.header.stamp.sec")


def test_the_scripts_make_band_and_residual(made, log):
    topic, fields = scripted(made)["/studio_script/joint_1"]
    assert topic == "/joint/1/state"
    messages = (
        log.decoded(topic, number)
        for number in range(len(log.messages[topic]) // 2, len(log.messages[topic]))
    )
    message = next(
        each for each in messages if math.isfinite(each["torque_nm"]) and math.isfinite(each["reference_nm"])
    )
    value = {
        name: eval(text, {"NaN": math.nan}, {"message": types.SimpleNamespace(**message)})
        for name, text in fields.items()
        if name != "contact"  # not an expression of Python as well
    }
    torque, sigma = message["torque_nm"], message["sigma_nm"]
    assert math.isfinite(torque)
    assert (value["upper_nm"], value["lower_nm"]) == (torque + sigma, torque - sigma)
    assert value["minus_sigma_nm"] == -sigma
    assert value["residual_nm"] == torque - message["reference_nm"]


def test_the_scripts_know_a_contact_from_none_and_from_not_known(made):
    _, fields = scripted(made)["/studio_script/joint_2"]
    test = re.fullmatch(
        r"\(message\.input_flags & (\d+)\) === 0 \? NaN : \(message\.input_flags & (\d+)\) === 0 \? 0 : 1",
        fields["contact"],
    )
    assert test is not None
    assert tuple(map(int, test.groups())) == (FLAG_CONTACT_KNOWN, FLAG_CONTACT)


def test_viewers_name_status_and_kind_of_event(log):
    assert log.names_of_values("/joint/1/state", "status") == schemas.STATUS_NAMES
    assert log.names_of_values("/events", "kind") == schemas.EVENT_NAMES
    assert log.names_of_values("/joint/1/state", "statusword") == {}


def test_plots_follow_only_when_asked():
    plain, follow = layout()["configById"], layout(10.0)["configById"]
    assert not any("followingViewWidth" in panel for panel in plain.values())
    plots = [panel for name, panel in follow.items() if name.startswith("Plot!")]
    assert {panel["followingViewWidth"] for panel in plots} == {10.0}


@pytest.mark.parametrize(
    "path",
    [
        "/joint/3/state.torque_nm",
        "/joint/1/state.torque",
        "/joint/1/state.header.stamp.nothing",
        "/joint/1/state.torque_nm.more",
        "/can/frames.frames.id",
        "/can/frames.missed[0]",
        "joint/1/state torque_nm",
    ],
)
def test_the_check_refuses_what_is_not_there(log, path):
    with pytest.raises(ValueError, match=r".+"):
        print(log.kind(path))


def test_the_check_knows_arrays_and_filters(log):
    assert log.kind("/can/frames.frames[:]{id==385}.length") == "uint8"
    assert log.kind("/can/frames.stamps_ns[3]") == "int64"


def test_command(tmp_path, capsys):
    out = tmp_path / "jtqd.layout.json"
    assert jtq(["layout", "--out", str(out)]) == 0
    assert json.loads(out.read_text()) == json.loads(json.dumps(layout()))
    assert jtq(["layout", "--follow", "7"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(json.dumps(layout(7.0)))
    assert jtq(["layout", "--out", str(tmp_path / "none" / "x.json")]) == 1
    assert capsys.readouterr().err.startswith(f"jtq layout: {tmp_path}/none/x.json: No such file")
    assert [path.name for path in tmp_path.iterdir()] == ["jtqd.layout.json"]
