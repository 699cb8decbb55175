"""The table of faults, and the cases that are drawn from it: every row in states and on plants that the draw deals out.

A row says what is broken and how; its magnitudes are physical, drawn evenly over their logarithms, each case from a part of
the range of its own. Rows know nothing of what jtqd looks for.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

from tests.slow.faults import gateway as gw
from tests.slow.faults.gateway import Act, Active, Change
from tests.slow.faults.runs import PLANTS, RUN_S, STATES, Played, runs_of
from tests.slow.faults.trial import Case, rng_of

BEGIN_S: Final = (3.0, 3.4)
CASES_PER_ROW: Final = 4
PAIRS: Final = 120
POSITIONS: Final = ("motor position", "link position")
NUMBERS: Final = (*POSITIONS, "motor velocity", "current")

SIZES: Final = {
    "motor position": (0.01, 3.0),
    "link position": (1e-4, 1e-2),
    "motor velocity": (0.5, 50.0),
    "current": (0.1, 5.0),
}
"""Of an error: rad, rad, rad/s and A; one of a link of 1 mrad is 12 Nm in the gear."""


class Drawn(NamedTuple):
    """What a row made for a case: the act, the numbers of it in words, seconds that it lasts (None: from the start on to the
    end of the run), steps of the wall clock (seconds after the begin, size)."""

    act: Act
    words: str
    seconds: float | None
    clock_s: float = 0.0


@dataclass(frozen=True)
class Draw:
    """What a row may use: a generator, the part of the range (0 to 1), the run, the node that is broken."""

    rng: random.Random
    part: float
    run: Played
    node: int

    @property
    def other(self) -> int:
        return 3 - self.node

    def size(self, name: str) -> tuple[int, float]:
        """Return a size in counts, with a sign, and in SI units."""
        low, high = SIZES[name]
        size = low * (high / low) ** self.part * self.rng.choice((-1.0, 1.0))
        return max(1, abs(round(size / self.unit(name)))) * (1 if size > 0 else -1), size

    def unit(self, name: str) -> float:
        units = self.run.units[self.node - 1]
        return {"link position": units.link_rad, "current": units.ampere}.get(name, units.motor_rad)

    def between(self, low: float, high: float) -> float:
        return low * (high / low) ** self.part

    def seconds(self) -> float:
        return round(self.rng.uniform(0.3, 1.2), 3)


Make = Callable[[Draw], Drawn]


@dataclass(frozen=True)
class Row:
    """A line of the table: group and what is broken."""

    group: str
    name: str
    make: Make


_UNIT: Final = {"motor position": "rad", "link position": "rad", "motor velocity": "rad/s", "current": "A"}


def _number_rows(name: str, *, more: bool = False) -> list[Row]:
    """Return the rows of one number of a drive; more: those of LATER."""

    def row(kind: str, change: Callable[[Draw], tuple[Change, str]], seconds: float | None = 0.0) -> Row:
        def make(draw: Draw) -> Drawn:
            made, words = change(draw)
            return Drawn(
                gw.of_field(name, draw.node, made), words, draw.seconds() if seconds == 0.0 else seconds
            )

        return Row(name, kind, make)

    def sized(kind: str, make: Callable[[Draw, int], Change], seconds: float | None = 0.0) -> Row:
        def change(draw: Draw) -> tuple[Change, str]:
            counts, size = draw.size(name)
            return make(draw, counts), f"{abs(size):.3g} {_UNIT[name]}"

        return row(kind, change, seconds)

    def cycles(draw: Draw) -> int:
        return round(draw.between(2.0, 60.0))

    def held(draw: Draw) -> tuple[Change, str]:
        n = cycles(draw)
        return gw.held(n), f"{n} cycles"

    def spikes(draw: Draw, counts: int) -> Change:
        return gw.spikes(draw.rng, abs(counts), draw.rng.choice((3, 10, 25, 100)))

    def factor(draw: Draw) -> tuple[Change, str]:
        f = 1.0 + draw.rng.choice((-1.0, 1.0)) * draw.between(0.02, 0.6)
        return gw.scaled(f), f"{f:.3f}"

    def bits(draw: Draw) -> tuple[int, str]:
        low, high = (0, 8) if name in ("current", "motor velocity") else (2, 16)
        bit = low + int(draw.part * (high - low))
        return 1 << bit, f"bit {bit}"

    def lower(draw: Draw) -> tuple[Change, str]:
        mask, text = bits(draw)
        return gw.stuck_bits(mask - 1, draw.rng.random() < 0.5), f"below {text}"

    def one_bit(draw: Draw) -> tuple[Change, str]:
        mask, text = bits(draw)
        return gw.stuck_bits(mask, draw.rng.random() < 0.5), text

    def flips(draw: Draw) -> tuple[Change, str]:
        mask, text = bits(draw)
        share = draw.rng.choice((0.5, 0.1, 0.02))
        return gw.flipped_bits(draw.rng, mask, share), f"{text}, {100 * share:g} % of frames"

    def older(draw: Draw) -> tuple[Change, str]:
        n = round(draw.between(1.0, 40.0))
        return gw.old(name, draw.node, n), f"{n} cycles"

    def of_another(draw: Draw) -> tuple[Change, str]:
        other = {"motor position": "link position", "link position": "motor position"}.get(name)
        if other is None or draw.part < 0.5:
            return gw.swapped(name, draw.other), f"that of drive {draw.other}"
        return gw.swapped(other, draw.node), other

    def losing(draw: Draw) -> tuple[Change, str]:
        part = draw.rng.choice((-1.0, 1.0)) * draw.between(3e-4, 0.3)
        return gw.losing(part), f"{100 * part:.3g} %"

    def eccentric(draw: Draw, counts: int) -> Change:
        return gw.eccentric(counts, draw.rng.choice((1, 2)), 2.0 * math.pi / draw.unit(name))

    whole = None
    if more:
        return [row("loses counts", losing), sized("eccentric", eccentric)]
    return [
        row("frozen", lambda draw: (gw.frozen(), "")),
        row("held for some cycles", held),
        sized("noise", lambda draw, n: gw.noise(draw.rng, abs(n))),
        sized("spikes", spikes),
        sized("step", lambda draw, n: gw.step(n)),
        sized("ramp and back", lambda draw, n: gw.ramp(n, 1000), 1.0),
        sized("offset from the start", lambda draw, n: gw.step(n), whole),
        row("scale", factor),
        row("scale from the start", factor, whole),
        row("sign", lambda draw: (gw.scaled(-1.0), "")),
        sized("saturated", lambda draw, n: gw.saturated(abs(n))),
        row("number of another", of_another),
        row("byte order", lambda draw: (gw.reversed_bytes(name), "")),
        row("lower bits stuck", lower),
        row("a bit stuck", one_bit),
        row("a bit flips", flips),
        row("old, frame in time", older),
    ]


def _frame_rows(*, more: bool = False) -> list[Row]:
    def ids(draw: Draw) -> tuple[int, ...]:
        """Return one PDO of the drive or both."""
        both = (0x180 + draw.node, 0x280 + draw.node)
        return draw.rng.choice((both[:1], both[1:], both))

    def named(cob_ids: tuple[int, ...]) -> str:
        return " ".join(f"{each:X}h" for each in cob_ids)

    def row(
        name: str, make: Callable[[Draw, tuple[int, ...]], tuple[Act, str]], group: str = "frames"
    ) -> Row:
        def drawn(draw: Draw) -> Drawn:
            chosen = ids(draw)
            act, words = make(draw, chosen)
            return Drawn(act, f"{named(chosen)} {words}".strip(), draw.seconds())

        return Row(group, name, drawn)

    def late_by_a_cycle(draw: Draw, chosen: tuple[int, ...]) -> tuple[Act, str]:
        us = 1000.0 + draw.rng.uniform(-60.0, 60.0)
        return gw.late(us, *chosen), f"{us:.0f} us"

    def other_pdo(draw: Draw, chosen: tuple[int, ...]) -> tuple[Act, str]:
        def act(n: int, traffic: gw.Traffic) -> None:
            for message in traffic.of(*chosen):
                message.data = traffic.sent(message.cob_id ^ 3, 0) or message.data  # 1 and 2

        return act, f"data of drive {draw.other}"

    def old(draw: Draw, chosen: tuple[int, ...]) -> tuple[Act, str]:
        n = round(draw.between(1.0, 200.0))
        return gw.old_frames(n, *chosen), f"{n} cycles"

    def drift(draw: Draw, chosen: tuple[int, ...]) -> tuple[Act, str]:
        share = draw.between(1e-3, 0.3)
        return gw.slow_clock(share, *chosen), f"{100 * share:.1f} %"

    def lost(draw: Draw, chosen: tuple[int, ...]) -> tuple[Act, str]:
        n = round(draw.between(2.0, 50.0))
        return gw.lost(n, *chosen), f"one in {n}"

    def constant(draw: Draw, chosen: tuple[int, ...]) -> tuple[Act, str]:
        byte = draw.rng.choice((0, 0xFF))
        return gw.replaced(bytes([byte]) * 8, *chosen), f"{byte:02X}h"

    def late(draw: Draw, chosen: tuple[int, ...]) -> tuple[Act, str]:
        us = draw.between(20.0, 500.0)
        return gw.late(us, *chosen), f"{us:.0f} us"

    def later(draw: Draw, chosen: tuple[int, ...]) -> tuple[Act, str]:
        us = draw.between(700.0, 6000.0)
        return gw.late(us, *chosen), f"{us:.0f} us"

    def jitter(draw: Draw, chosen: tuple[int, ...]) -> tuple[Act, str]:
        us = draw.between(100.0, 3000.0)
        return gw.jittered(draw.rng, us, *chosen), f"{us:.0f} us"

    def early(draw: Draw, chosen: tuple[int, ...]) -> tuple[Act, str]:
        us = draw.between(10.0, 150.0)
        return gw.early(us, *chosen), f"{us:.0f} us"

    def doubled(draw: Draw, chosen: tuple[int, ...]) -> tuple[Act, str]:
        ago = round(draw.between(1.0, 20.0))
        return gw.doubled(ago, *chosen), f"with that of {ago} cycles ago"

    def short(draw: Draw, chosen: tuple[int, ...]) -> tuple[Act, str]:
        length = draw.rng.randrange(8)
        return gw.cut_short(length, *chosen), f"{length} bytes"

    rows = [
        row("all bytes repeated", lambda draw, chosen: (gw.repeated(*chosen), "")),
        row("old data in time", old),
        row("slow clock of the node", drift),
        row("data of another drive", other_pdo),
        row("all bytes equal", constant),
        row("too short", short),
        row("late, in time", late, "timing"),
        row("late", later, "timing"),
        row("late by a cycle", late_by_a_cycle, "timing"),
        row("early", early, "timing"),
        row("jitter", jitter, "timing"),
        row("twice", lambda draw, chosen: (gw.doubled(0, *chosen), ""), "timing"),
        row("twice, different", doubled, "timing"),
        row("lost now and then", lost, "timing"),
        row("lost for a while", lambda draw, chosen: (gw.lost(1, *chosen), ""), "timing"),
    ]

    def of_drive(name: str, make: Callable[[Draw], tuple[Act, str, float | None]], group: str) -> Row:
        return Row(group, name, lambda draw: Drawn(*make(draw)))

    def all_repeated(draw: Draw) -> tuple[Act, str, float | None]:
        return gw.repeated(0x180 + draw.node, 0x280 + draw.node), "all PDOs of a drive", draw.seconds()

    def all_old(draw: Draw) -> tuple[Act, str, float | None]:
        n = round(draw.between(1.0, 200.0))
        return gw.old_frames(n, 0x180 + draw.node, 0x280 + draw.node), f"{n} cycles", draw.seconds()

    def everything_old(draw: Draw) -> tuple[Act, str, float | None]:
        n = round(draw.between(1.0, 200.0))
        return gw.old_frames(n), f"{n} cycles", draw.seconds()

    def wall_clock(draw: Draw) -> Drawn:
        size = draw.rng.choice((-1.0, 1.0)) * draw.between(0.01, 100.0)
        return Drawn(lambda n, traffic: None, f"{size:.3g} s", 0.1, size)

    def word(draw: Draw) -> tuple[Act, str, float | None]:
        mask = draw.rng.randrange(1, 1 << 16)
        change = gw.flipped_bits(draw.rng, mask, 0.3)
        return gw.of_field("statusword", draw.node, change), f"{mask:04X}h", draw.seconds()

    def word_is(value: int) -> Callable[[Draw], tuple[Act, str, float | None]]:
        def make(draw: Draw) -> tuple[Act, str, float | None]:
            act = gw.of_field("statusword", draw.node, lambda n, old_value, traffic: value)
            return act, f"{value:04X}h", draw.seconds()

        return make

    def celsius(draw: Draw) -> tuple[Act, str, float | None]:
        tenths = round(10.0 * draw.between(3.0, 80.0)) * draw.rng.choice((-1, 1))
        return gw.of_field("temperature", draw.node, gw.step(tenths)), f"{tenths / 10:g} K", 1.5

    def celsius_lost(draw: Draw) -> tuple[Act, str, float | None]:
        return gw.lost(1, 0x380 + draw.node), "", 2.6

    def sensor(change: Callable[[Draw, int], Change]) -> Callable[[Draw], tuple[Act, str, float | None]]:
        def make(draw: Draw) -> tuple[Act, str, float | None]:
            size = round(1000.0 * draw.between(0.5, 60.0))
            act = gw.of_field("sensor", gw.SENSOR_NODE, change(draw, size))
            return act, f"{size / 1000:g} Nm", draw.seconds()

        return make

    def again(from_zero: str | None) -> Callable[[Draw], tuple[Act, str, float | None]]:
        def make(draw: Draw) -> tuple[Act, str, float | None]:
            cycles = round(draw.between(5.0, 400.0))
            return gw.restarted(draw.node, cycles, from_zero), f"silent for {cycles} cycles", RUN_S

        return make

    def again_as_other(draw: Draw) -> tuple[Act, str, float | None]:
        away, words, seconds = again(None)(draw)
        data, _ = other_pdo(draw, (0x180 + draw.node, 0x280 + draw.node))

        def act(n: int, traffic: gw.Traffic) -> None:
            away(n, traffic)
            data(n, traffic)

        return act, words, seconds

    if more:
        return [of_drive("restart, data of the other", again_as_other, "nodes")]
    rows += [
        of_drive("all PDOs of a drive repeated", all_repeated, "frames"),
        of_drive("all PDOs of a drive old", all_old, "frames"),
        of_drive("all PDOs old", everything_old, "frames"),
        Row("timing", "wall clock set", wall_clock),
        of_drive("bits of the statusword", word, "nodes"),
        of_drive("statusword: off", word_is(gw.SWITCHED_OFF), "nodes"),
        of_drive("statusword: fault", word_is(gw.FAULT_WORD), "nodes"),
        of_drive("restart", again(None), "nodes"),
        of_drive("restart, motor position from 0", again("motor position"), "nodes"),
        of_drive("restart, link position from 0", again("link position"), "nodes"),
        of_drive("silent", lambda draw: (gw.silent(draw.node), "", draw.seconds()), "nodes"),
        of_drive("all silent", lambda draw: (gw.silent(1, 2, 3), "", draw.seconds()), "nodes"),
        of_drive("two drives exchanged", lambda draw: (gw.exchanged(1, 2), "", draw.seconds()), "nodes"),
        of_drive("two nodes with one ID", lambda draw: (gw.both_as(1, 2), "", draw.seconds()), "nodes"),
        of_drive(
            "heartbeat pre-operational",
            lambda draw: (gw.heartbeat(gw.PRE_OPERATIONAL, draw.node), "", draw.seconds()),
            "nodes",
        ),
        of_drive("heartbeat lost", lambda draw: (gw.lost(1, 0x700 + draw.node), "", 1.2), "nodes"),
        of_drive(
            "SYNC of another", lambda draw: (gw.added(0x080, b"\x05", 300.0, 7), "", draw.seconds()), "nodes"
        ),
        of_drive(
            "1A0h of another",
            lambda draw: (gw.added(0x1A0, bytes(8), 400.0, 5), "", draw.seconds()),
            "nodes",
        ),
        of_drive("temperature: step", celsius, "temperature, sensor"),
        of_drive("temperature: lost", celsius_lost, "temperature, sensor"),
        of_drive(
            "sensor: noise",
            sensor(lambda draw, size: gw.noise(draw.rng, size)),
            "temperature, sensor",
        ),
        of_drive("sensor: step", sensor(lambda draw, size: gw.step(size)), "temperature, sensor"),
        of_drive("sensor: frozen", sensor(lambda draw, size: gw.frozen()), "temperature, sensor"),
    ]
    return rows


EARLIER: Final = (*(row for name in NUMBERS for row in _number_rows(name)), *_frame_rows())
LATER: Final = (
    *(row for name in POSITIONS for row in _number_rows(name, more=True)),
    *_frame_rows(more=True),
)
"""Dealt by a draw of their own: they change no case of the earlier ones."""
ROWS: Final = (*EARLIER, *LATER)


# The draw --------------------------------------------------------------------------------------------------------------


def _dealt(rng: random.Random, count: int) -> list[tuple[str, str]]:
    """Return (plant, state) of `count` cases: every plant and every state equally often, whatever the count."""
    found: list[tuple[str, str]] = []
    while len(found) < count:
        every = [(plant, state) for plant in PLANTS for state in STATES]
        rng.shuffle(every)
        found += every
    return found[:count]


def _active(draw: Draw, row: Row, begin: int) -> tuple[Active, str, tuple[tuple[int, float], ...]]:
    drawn = row.make(draw)
    length = len(draw.run.frames)
    if drawn.seconds is None:
        begin, end = 0, length
    else:
        end = min(begin + round(1000 * drawn.seconds), length)
    steps = ((begin, drawn.clock_s),) if drawn.clock_s else ()
    words = f"{row.group}: {row.name} {drawn.words}".strip()
    return Active(begin, end, drawn.act), f"{words}, drive {draw.node}", steps


def singles(seed: int, per_row: int = CASES_PER_ROW) -> list[Case]:
    """Return the cases of single faults: `per_row` of each row, its range of magnitudes in as many parts."""
    return [
        *_dealt_singles(seed, per_row, "singles", EARLIER),
        *_dealt_singles(seed, per_row, "later", LATER),
    ]


def _dealt_singles(seed: int, per_row: int, name: str, rows: tuple[Row, ...]) -> list[Case]:
    rng = rng_of(seed, name)
    places = _dealt(rng, len(rows) * per_row)
    cases = []
    for number, row in enumerate(rows):
        # the deals of a row are apart, so that its cases have different plants and states
        mine = places[number :: len(rows)]
        order = list(range(per_row))
        rng.shuffle(order)
        for k, (plant, state) in enumerate(mine):
            own = rng_of(seed, row.group, row.name, k)
            run = runs_of(plant, seed)[state]
            draw = Draw(own, (order[k] + own.random()) / per_row, run, own.choice((1, 2)))
            begin = round(1000 * own.uniform(*BEGIN_S))
            fault, words, steps = _active(draw, row, begin)
            cases.append(
                Case(
                    f"{row.group}: {row.name}",
                    row.group,
                    plant,
                    state,
                    seed,
                    words,
                    fault.begin,
                    fault.end,
                    (fault,),
                    steps,
                )
            )
    return cases


def pairs(seed: int, count: int = PAIRS) -> list[Case]:
    """Return cases of two faults at once, three of four in the same drive."""
    rng = rng_of(seed, "pairs")
    cases = []
    for k, (plant, state) in enumerate(_dealt(rng, count)):
        own = rng_of(seed, "pair", k)
        run = runs_of(plant, seed)[state]
        node = own.choice((1, 2))
        one, two = own.sample(EARLIER, 2)
        made = []
        for row, at in ((one, node), (two, node if own.random() < 0.75 else 3 - node)):
            begin = round(1000 * own.uniform(*BEGIN_S))
            made.append(_active(Draw(own, own.random(), run, at), row, begin))
        faults = tuple(each[0] for each in made)
        words = " + ".join(each[1] for each in made)
        steps = tuple(step for each in made for step in each[2])
        cases.append(
            Case(
                "pair",
                "pairs",
                plant,
                state,
                seed,
                words,
                min(each.begin for each in faults),
                max(each.end for each in faults),
                faults,
                steps,
            )
        )
    return cases
