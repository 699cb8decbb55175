"""Numbers as text: digits, units, intervals, plurals."""

from __future__ import annotations

import math
from typing import Any

import pytest

from jtqd.sysid.report.numbers import number, percent, rounded, short, with_interval, with_unit

PLAIN_SPACE = str.maketrans("\u00a0\u202f", "  ")


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        ((0.418, (0.397, 0.439), "Nm"), ("0.418 Nm", "[0.397, 0.439]")),
        ((5.7231, (4.1, 7.3), "Nms/rad"), ("5.7 Nm s/rad", "[4.1, 7.3]")),
        ((4.13e-5, (3.9e-5, 4.4e-5), "rad"), ("41.3 µrad", "[39.0, 44.0]")),
        ((-0.0042, (-0.005, -0.0034), "s"), ("-4.20 ms", "[-5.00, -3.40]")),
        ((3.2e-5, (3.0e-5, 3.4e-5), "kgm2"), ("3.20e-05 kg m²", "[3.00e-05, 3.40e-05]")),
        ((15200.0, (14100.0, 16300.0), "Nm/rad"), ("15200 Nm/rad", "[14100, 16300]")),
        ((2.0, (2.0, 2.0), ""), ("2.00", "")),
        ((0.3, (-math.inf, math.inf), "Nm"), ("0.300 Nm", "")),
        ((0.0, (-0.1, 0.1), "Nm"), ("0 Nm", "[-0.10, 0.10]")),
        ((4.0, (3.9, 4.1), "Nm", 3.0), ("3.00 -> 4.00 Nm", "[3.90, 4.10]")),
    ],
)
def test_a_value_has_the_digits_that_its_interval_allows(
    value: tuple[Any, ...], shown: tuple[str, str]
) -> None:
    text, interval = with_interval(*value)
    assert (text.translate(PLAIN_SPACE), interval.translate(PLAIN_SPACE)) == shown


def test_numbers_for_people() -> None:
    assert [number(x) for x in (0.0, 0.20349, 12.345, 1234.5, -0.5, math.nan)] == [
        "0",
        "0.203",
        "12.3",
        "1\u202f234",
        "−0.500",
        "–",
    ]
    assert [percent(x).translate(PLAIN_SPACE) for x in (0.123, -0.001, math.inf)] == ["12 %", "0 %", "–"]
    assert with_unit(0.0063, "A", 2).translate(PLAIN_SPACE) == "6.3 mA"
    assert with_unit(3.2e-5, "kgm2").translate(PLAIN_SPACE) == "3.20 × 10⁻⁵ kg m²"
    assert with_unit(15200.0, "Nm/rad").translate(PLAIN_SPACE) == "15 200 Nm/rad"
    assert [short(x) for x in (0.0123, 5.7, 1.0, 123.4, 0.0)] == ["0.012", "5.7", "1.0", "123", "0"]
    assert [rounded(1.0481, "1", 1.0), rounded(0.0123, "A")] == ["1.00 -> 1.05", "12 mA"]
