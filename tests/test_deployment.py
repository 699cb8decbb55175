"""The unit and the page about it say the same."""

import configparser
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_the_page_names_the_directories_of_the_unit():
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str
    unit.read(ROOT / "systemd" / "jtqd@.service")
    page = (ROOT / "docs" / "deployment.md").read_text(encoding="utf-8")
    service = unit["Service"]
    assert f"`/run/{service['RuntimeDirectory'].replace('%i', 'INTERFACE')}/jtqd-UID-INTERFACE`" in page
    assert f"`/var/log/{service['LogsDirectory']}`" in page
    assert service["ExecStart"].split("--config ")[1].replace("%I", "INTERFACE") in page
