"""`jtq schema`: what the decoder takes is valid by the schema, and what is refused for a key alone is not."""

import copy
import json
import re

import pytest
import yaml

from jtqd.daemon import jtq
from jtqd.daemon.cli.schema import FILES, schema_of
from jtqd.daemon.config import load_config
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.sysid.planner.campaigns import Scale, make_plan
from jtqd.sysid.planner.plan import Plan
from tests.paths import ROOT

TYPES = {
    "object": lambda x: isinstance(x, dict),
    "array": lambda x: isinstance(x, list),
    "string": lambda x: isinstance(x, str),
    "boolean": lambda x: isinstance(x, bool),
    "null": lambda x: x is None,
    "integer": lambda x: isinstance(x, int) and not isinstance(x, bool),
    "number": lambda x: isinstance(x, int | float) and not isinstance(x, bool),
}
RULES = {
    "type": lambda x, rule: TYPES[rule](x),
    "const": lambda x, rule: x == rule and isinstance(x, type(rule)),
    "enum": lambda x, rule: x in rule,
    "pattern": lambda x, rule: re.search(rule, x) is not None,
    "minimum": lambda x, rule: x >= rule,
    "exclusiveMinimum": lambda x, rule: x > rule,
    "maximum": lambda x, rule: x <= rule,
    "minItems": lambda x, rule: len(x) >= rule,
    "maxItems": lambda x, rule: len(x) <= rule,
    "required": lambda x, rule: set(rule) <= x.keys(),
    "anyOf": lambda x, rule: any(valid(x, each) for each in rule),
    "prefixItems": lambda x, rule: all(map(valid, x, rule)),
    "items": lambda x, rule: rule is False or all(valid(each, rule) for each in x),
    "properties": lambda x, rule: all(valid(each, rule[key]) for key, each in x.items() if key in rule),
}
"""Keywords of JSON Schema 2020-12, as far as they are used."""
TEXTS = {"description", "title", "$schema"}


def valid(value, schema):
    if "type" in schema and not TYPES[schema["type"]](value):
        return False
    more = schema.get("additionalProperties", {})
    if isinstance(value, dict) and "properties" in schema | {"additionalProperties": 0}:
        free = [each for key, each in value.items() if key not in schema.get("properties", {})]
        if (more is False and free) or (more and not all(valid(each, more) for each in free)):
            return False
    return all(
        RULES[name](value, rule)
        for name, rule in schema.items()
        if name not in TEXTS | {"additionalProperties"}
    )


def read(file, content, tmp_path):
    """As the program that the file is for."""
    if file == "joint":
        return Joint.from_mapping(content, "joint.yaml", elastic=False)
    if file == "plan":
        return Plan.from_mapping(content, "plan.yaml")
    (tmp_path / "bench.yaml").write_text(yaml.safe_dump(content))
    return load_config(tmp_path / "bench.yaml")


SHIPPED = {
    "config": [ROOT / "models" / "bench.yaml", ROOT / "models" / "bench_paper.yaml"],
    "joint": [*(ROOT / "models").glob("joint?.yaml"), *(ROOT / "models" / "trained").glob("joint?.yaml")],
    "plan": list(ROOT.glob("examples/**/*.plan.yaml")),
}


@pytest.mark.parametrize("file", FILES)
def test_shipped_files_are_valid(file):
    schema = schema_of(file)
    assert SHIPPED[file]
    contents = [yaml.safe_load(path.read_text()) for path in SHIPPED[file]]
    if file == "plan":
        contents += [
            yaml.safe_load(make_plan(name, Scale()).to_yaml()) for name in ("efficiency", "validate", "quick")
        ]
    for content in contents:
        assert valid(content, schema)


def changed(content, path, value):
    """A copy with another value at a dotted path; None: without the key."""
    result = copy.deepcopy(content)
    *inner, last = path.split(".")
    at = result
    for key in inner:
        at = at[int(key)] if isinstance(at, list) else at.setdefault(key, {})
    if value is None:
        del at[last]
    else:
        at[last] = value
    return result


WRONG = [
    ("config", "node_id", None),
    ("config", "node_id", 200),
    ("config", "node_id", "one"),
    ("config", "nodeid", 32),
    ("config", "role", "boss"),
    ("config", "joint_1.node", "x"),
    ("config", "joint_1.nodes", 1),
    ("config", "sync.period_us", -1),
    ("config", "estimator.method", "magic"),
    ("config", "realtime", 5),
    ("joint", "gear_ratio", 0),
    ("joint", "gear_ratio", "high"),
    ("joint", "rated_torque_nm", None),
    ("joint", "friction.coulomb_nm", -1.0),
    ("joint", "friction.colomb_nm", 1.0),
    ("joint", "name", ""),
    ("plan", "schema", "jtq.plan/99"),
    ("plan", "runs", []),
    ("plan", "runs.0.segments.0.kind", "jump"),
    ("plan", "runs.0.segments.0.hold_s", -1.0),
    ("plan", "runs.0.velocity_joint", 12),
    ("plan", "runs.0.colour", "red"),
]


@pytest.mark.parametrize(("file", "path", "value"), WRONG)
def test_what_the_decoder_refuses_for_a_key_is_not_valid(tmp_path, file, path, value):
    good = {
        "config": yaml.safe_load((ROOT / "models" / "bench.yaml").read_text()),
        "joint": yaml.safe_load((ROOT / "models" / "joint1.yaml").read_text()),
        "plan": yaml.safe_load(make_plan("efficiency", Scale()).to_yaml()),
    }[file]
    content = changed(good, path, value)
    with pytest.raises(ConfigError):
        read(file, content, tmp_path)
    assert valid(good, schema_of(file))
    assert not valid(content, schema_of(file))


@pytest.mark.parametrize(
    ("path", "value"),
    [("joint_1.temperature", False), ("joint_1.objects", {"link_position": False}), ("sync", None)],
)
def test_what_a_file_may_leave_out_or_refuse_is_valid(path, value):
    good = yaml.safe_load((ROOT / "models" / "bench.yaml").read_text())
    content = {**good, path: None} if value is None else changed(good, path, value)
    assert valid(content, schema_of("config"))


@pytest.mark.parametrize("file", FILES)
def test_the_command_prints_json(file, capsys):
    assert jtq.main(["schema", file]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == schema_of(file)
    assert "\\A" not in json.dumps(found), "an anchor of Python alone"
