"""Where the things of the source tree are that tests read."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
GOLDEN = ROOT / "tests" / "golden"
EDS = ROOT / "drivers" / "eds"
JTQD_EDS = EDS / "jtqd.eds"
