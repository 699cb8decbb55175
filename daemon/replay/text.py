"""Results of a replay as lines for people."""

from __future__ import annotations

from math import isnan

from daemon.replay.compare import Comparison
from daemon.replay.difference import Difference, Identity, Unknown
from daemon.replay.session import Result


def number(count: int) -> str:
    """Thousands by a narrow gap: 29 981."""
    return f"{count:,}".replace(",", " ")


def text(result: Result, *, compared: bool) -> str:
    """Everything about one run; `compared`: with the differences, although the models are those of the log."""
    lines = [*_head(result)]
    if result.identity is not None:
        lines += _identity(result, result.identity)
    if compared or result.identity is None:
        lines += [line for each in result.comparisons for line in _comparison(each, result.identity is None)]
    return "\n".join(lines)


def _head(result: Result) -> list[str]:
    logs = ", ".join(str(part.path) for part in result.run.parts)
    way = "cycle by cycle, by the loop's own code" if result.exact else "whole run in arrays"
    speed = result.seconds / max(result.replay_s, 1e-9)
    lines = [
        logs,
        f"  {number(result.run.cycles)} cycles, {result.seconds:.3f} s, method {result.method}; {way}: "
        f"{result.replay_s:.2f} s ({speed:.0f} times real time), reading {result.read_s:.2f} s",
    ]
    if result.identity is None:
        lines += [f"  joint {n}: {file}" for n, file in enumerate(result.files, start=1)]
    if result.lost:
        lines.append(f"  {number(result.lost)} cycles are missing in the middle of the log")
    if result.from_si:
        lines.append(
            f"  {number(result.from_si)} inputs have no frame in the log: taken from the SI values beside it"
        )
    if result.temperatures_from_log:
        lines.append(
            f"  {number(result.temperatures_from_log)} times the frames do not tell the temperature: taken from the log"
        )
    return lines


def _identity(result: Result, same: Identity) -> list[str]:
    verdict = f"{number(same.identical)} of {number(same.cycles)} cycles"
    since = same.from_cycle
    from_on = "" if since in (None, _first_cycle(result)) else f" from cycle {number(since)} on"
    if not result.exact:
        word = "equal" if same.explained else "NOT equal"
        lines = [
            f"  {word} to {same.tolerance_nm:g} Nm{from_on}; bit-identical: {verdict} (in arrays; --exact compares bits)"
        ]
    elif same.explained and since is not None:
        lines = [f"  bit-identical{from_on}: {verdict}"]
    else:
        lines = [f"  NOT bit-identical: {verdict}"]
    if same.pdos:
        lines.append(
            f"  estimate PDO on the bus: same bytes in {number(same.pdos_equal)} of {number(same.pdos)}"
        )
    if not result.exact:
        for each in result.comparisons:
            lines.append(
                f"  joint {each.joint}: same estimate PDO in {number(each.pdo_equal)} of {number(each.cycles)} cycles, "
                f"largest difference {_nm(each.max_nm, 'g')}"
            )
    lines += [_unknown(each) for each in same.unknown]
    lines += [_difference(each) for each in same.differences]
    return lines


def _first_cycle(result: Result) -> int:
    return int(result.run.joints[0]["cycle"][0])


def _unknown(each: Unknown) -> str:
    if each.until_end:
        return (
            f"  joint {each.joint}: from cycle {number(each.first_cycle)} on the observer's state is not known "
            f"({each.reason}), and {number(each.cycles)} cycles were too few to forget it"
        )
    return (
        f"  joint {each.joint}: from cycle {number(each.first_cycle)} on the observer's state was not known "
        f"({each.reason}); identical again {number(each.cycles)} cycles later"
    )


def _difference(each: Difference) -> str:
    if each.joint == 0:
        return f"  the estimate PDO's bytes differ in {number(each.cycles)} cycles, first in {number(each.cycle)}"
    return (
        f"  joint {each.joint}: {each.field} differs from cycle {number(each.cycle)} on, in {number(each.cycles)} "
        f"cycles: {each.logged:.6g} -> {each.replayed:.6g}; torque by {each.largest_nm:.3g} Nm at most"
    )


def _nm(value: float, form: str = ".3f") -> str:
    return "-" if isnan(value) else f"{value:{form}} Nm"


def _comparison(each: Comparison, other: bool) -> list[str]:
    now = "now" if other else "replayed"
    largest = "" if each.max_cycle is None else f" in cycle {number(each.max_cycle)}"
    lines = [
        f"  joint {each.joint}: torque differs by {_nm(each.rms_nm, '.4f')} rms, {_nm(each.max_nm, '.4f')} at most{largest}"
        f" ({number(each.both)} cycles)",
    ]
    if each.sensor_cycles:
        better = each.sensor_replayed_nm / each.sensor_logged_nm - 1.0 if each.sensor_logged_nm else 0.0
        lines.append(
            f"    against the torque sensor: {_nm(each.sensor_logged_nm)} rms as logged, "
            f"{_nm(each.sensor_replayed_nm)} {now} ({better:+.1%})"
        )
    lines.append(f"    mean sigma {_nm(each.sigma_logged_nm)} as logged, {_nm(each.sigma_replayed_nm)} {now}")
    share = each.status_changed / max(each.cycles, 1)
    said = ", ".join(f"{c.logged} -> {c.replayed} {number(c.cycles)}" for c in each.changes[:6])
    lines.append(f"    status changed in {share:.2%} of the cycles" + (f": {said}" if said else ""))
    return lines
