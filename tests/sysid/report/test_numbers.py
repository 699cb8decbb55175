"""Numbers as text: digits, units, intervals, plurals."""

from __future__ import annotations

import math

import pytest

from jtqd.sysid.report.numbers import number, percent, with_interval, with_unit

PLAIN_SPACE = str.maketrans("\u00a0\u202f", "  ")


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        ((0.418, (0.397, 0.439), "Nm"), ("0.418 Nm", "0.397 to 0.439")),
        ((5.7231, (4.1, 7.3), "Nms/rad"), ("5.7 Nm s/rad", "4.1 to 7.3")),
        ((4.13e-5, (3.9e-5, 4.4e-5), "rad"), ("41.3 µrad", "39.0 to 44.0")),
        ((-0.0042, (-0.005, -0.0034), "s"), ("−4.20 ms", "−5.00 to −3.40")),
        ((3.2e-5, (3.0e-5, 3.4e-5), "kgm2"), ("3.20 × 10⁻⁵ kg m²", "3.00 to 3.40")),
        ((15200.0, (14100.0, 16300.0), "Nm/rad"), ("15 200 Nm/rad", "14 100 to 16 300")),
        ((2.0, (2.0, 2.0), ""), ("2", "")),
        ((0.3, (-math.inf, math.inf), "Nm"), ("0.300 Nm", "not bounded by these runs")),
        ((math.nan, (math.nan, math.nan), "Nm"), ("–", "")),
        ((0.0, (-0.1, 0.1), "Nm"), ("0.00 Nm", "−0.10 to 0.10")),
    ],
)
def test_a_value_has_the_digits_that_its_interval_allows(
    value: tuple[float, tuple[float, float], str], shown: tuple[str, str]
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
