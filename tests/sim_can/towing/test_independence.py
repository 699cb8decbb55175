"""A bench that is a stand-in for the real world shares no law with what is judged on it."""

import re
from pathlib import Path

import jtqd.sim_can.towing

ROOM = Path(jtqd.sim_can.towing.__file__).parent
ALLOWED = {
    "jtqd.estimator.errors",  # reading of files
    "jtqd.estimator.decoder",
    "jtqd.estimator.joint",  # names and nominal values: what a drive believes
    "jtqd.sim_can.drives",  # the drives' own loops
    "jtqd.sim_can.source",
}


def test_imports_no_law_of_estimator_effects_or_simulation() -> None:
    sources = [path for path in ROOM.iterdir() if path.suffix in (".py", ".pyx", ".pxd")]
    assert len(sources) >= 4
    for path in sources:
        found = set(re.findall(r"^\s*(?:from|import|cimport)\s+(jtqd[\w.]*)", path.read_text("utf-8"), re.M))
        foreign = {name for name in found if not name.startswith("jtqd.sim_can.towing")} - ALLOWED
        assert not foreign, f"{path.name} imports {sorted(foreign)}"
