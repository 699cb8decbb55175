"""`cycle`: CPU per cycle of jtqd's loop, of the usual way and of plain C, alternating in rounds of one run.

C twice: waking up for the inputs at a fixed time after SYNC, and following their arrival as jtqd does.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.benchmarks import c_program, contender
from tests.benchmarks.contender import Process, Task, python
from tests.benchmarks.fixture import Fixture
from tests.benchmarks.measure import SETTLE_CYCLES, Samples, mark, table

JTQD, USUAL, C, FOLLOWING = "jtqd", "usual way", "C", "C, following"
USUAL_RATIO = 4.0
C_RATIO, C_P99_RATIO = 1.25, 1.6
"""Frames at once."""
WIRE_RATIO, WIRE_AFTER_LAST_US, WIRE_POINTS = 1.3, 60.0, -1.0
"""Frames as on a wire: against C whose wake-up follows the arrivals; the answer's p99; points of cycles with a torque."""


def run(
    fixture: Fixture, *, rounds: int, seconds: float, quiet: bool, bitrate: int | None = None
) -> dict[str, Any]:
    """Measure; `quiet` keeps the contenders' core awake (see contender.py), `bitrate` spaces the frames as a wire does."""
    program = c_program.build(fixture)
    where = contender.cpus()
    traffic = contender.traffic(fixture.directory, where, bitrate)
    bus = fixture.directory / "bus"
    task = Task(f"unix:{bus}", fixture.directory, where.loop)
    contenders = {
        JTQD: Process(python("contender_jtqd", task.to_json()), JTQD),
        USUAL: Process(python("contender_canopen", task.to_json()), USUAL),
        C: Process(_c_command(program, bus, task), C),
        FOLLOWING: Process([*_c_command(program, bus, task), "follow"], FOLLOWING),
    }
    spinner = contender.quiet_core(program, where) if quiet else None
    samples = {name: Samples() for name in contenders}
    load = contender.OtherLoad()
    try:
        for _ in range(rounds):
            for name, process in contenders.items():
                samples[name].add(process.run(SETTLE_CYCLES + round(seconds * 1000)))
        busy = load.cpus_busy()
    finally:
        for process in (*contenders.values(), traffic, *([spinner] if spinner else [])):
            process.end()
    figures = {name: each.figures() for name, each in samples.items()}
    return {
        "quiet_core": spinner is not None,
        "bitrate": bitrate,
        "rounds": rounds,
        "seconds": seconds,
        "cpus_busy": busy,
        "contenders": figures,
        "ratios": {
            "usual_over_jtqd": figures[USUAL]["cpu_median_us"] / figures[JTQD]["cpu_median_us"],
            "jtqd_over_c": figures[JTQD]["cpu_median_us"] / figures[C]["cpu_median_us"],
            "jtqd_over_c_p99": figures[JTQD]["cpu_p99_us"] / figures[C]["cpu_p99_us"],
            "jtqd_over_following": figures[JTQD]["cpu_median_us"] / figures[FOLLOWING]["cpu_median_us"],
            "after_last_p99_above_following_us": figures[JTQD]["after_last_p99_us"]
            - figures[FOLLOWING]["after_last_p99_us"],
            "with_torque_points": figures[JTQD]["with_torque_percent"]
            - max(figures[C]["with_torque_percent"], figures[FOLLOWING]["with_torque_percent"]),
        },
    }


COLUMNS = {
    "CPU median us": "{cpu_median_us:.1f}",
    "p99": "{cpu_p99_us:.1f}",
    "mean": "{cpu_mean_us:.1f}",
    "rounds": "{round_median_low_us:.1f}..{round_median_high_us:.1f}",
    "answer us": "{answer_median_us:.0f}",
    "p99 ": "{answer_p99_us:.0f}",
    "after last us": "{after_last_median_us:.0f}",
    "p99  ": "{after_last_p99_us:.0f}",
    "sleeps": "{switches_per_cycle:.1f}",
    "cycles": "{cycles:.0f}",
    "missed": "{missed:.0f}",
    "with torque": "{with_torque_percent:.1f} %",
}
"""Head of a column and what stands in it, of `Samples.figures`."""


def _c_command(program: Path, bus: Path, task: Task) -> list[str]:
    cpu = -1 if task.cpu is None else task.cpu
    return [str(program), "run", str(bus), str(cpu), str(task.priority), str(task.directory / "c.ring")]


def text(result: dict[str, Any]) -> str:
    core = "quiet core" if result["quiet_core"] else "core shared with the system"
    spacing = f"frames at {result['bitrate']} bit/s" if result["bitrate"] else "frames at once"
    lines = [
        f"CPU per cycle, {core}, {spacing}: {result['rounds']} rounds of {result['seconds']:g} s each, "
        f"{result['cpus_busy']:.1f} CPUs busy",
        "",
    ]
    rows = [
        [name, *(form.format(**f) for form in COLUMNS.values())] for name, f in result["contenders"].items()
    ]
    head = ["", *(text.strip() for text in COLUMNS)]
    lines.append(table(head, rows))
    ratios = result["ratios"]
    lines += [
        "",
        f"usual way / jtqd             {ratios['usual_over_jtqd']:6.2f}     "
        + mark(ratios["usual_over_jtqd"], USUAL_RATIO, at_least=True),
    ]
    if result["bitrate"]:
        over, after, points = (
            ratios[key]
            for key in ("jtqd_over_following", "after_last_p99_above_following_us", "with_torque_points")
        )
        lines += [
            f"jtqd / C, following          {over:6.2f}     {mark(over, WIRE_RATIO)}",
            f"answer after last input, p99 {after:+6.0f} us  {mark(after, WIRE_AFTER_LAST_US)} above C, following",
            f"cycles with a torque         {points:+6.2f}     {mark(points, WIRE_POINTS, at_least=True)} "
            "points against the better C",
        ]
    else:
        over, p99 = ratios["jtqd_over_c"], ratios["jtqd_over_c_p99"]
        lines += [
            f"jtqd / C, median             {over:6.2f}     {mark(over, C_RATIO)}",
            f"jtqd / C, p99                {p99:6.2f}     {mark(p99, C_P99_RATIO)}",
        ]
    return "\n".join(lines)
