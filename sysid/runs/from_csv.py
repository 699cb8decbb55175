"""`jtq init --from-csv`: tables -> column map, joint files with every open key, and the command that reads them.

columns.yaml      where each column of the run table comes from; what is open is a comment with ???
joint.yaml        or joint_N.yaml where there are several joints, or a single one has another number than 1
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from jtqd.estimator.command_line import command_parser, make_directory
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.files import write_whole
from jtqd.estimator.joint import ELASTIC
from jtqd.estimator.text import table_lines
from jtqd.sysid.progress import progress
from jtqd.sysid.runs.column_names import TORQUE, VOLTAGE, quoted
from jtqd.sysid.runs.files import TABLES, ends_in, run_paths
from jtqd.sysid.runs.propose import DRIVE, OPEN, Guess, JointProposal, Proposal, ProposalError, propose
from jtqd.sysid.runs.run_file import RunError
from jtqd.sysid.runs.tables import read_columns

BY: Final = "jtq init"
COLUMNS: Final = "columns.yaml"
_EXAMPLES: Final = """examples:
  jtq init --from-csv swing_*.csv                      columns.yaml and joint.yaml, in this directory
  jtq init --from-csv recordings --out rig --force

exit status: 0 the files are there, 1 no proposal can be made, 2 usage"""


def main(argv: list[str]) -> int:
    """Look at the tables, write the files, print what is open; returns the exit status."""
    options = parser().parse_args(argv)
    if not options.from_csv:  # argparse would refuse `--from-csv --help` before it sees --help
        parser().error("--from-csv: found no file, expected one or more")
    try:
        paths = run_paths(options.from_csv)
        wrong = next((path for path in paths if not ends_in(path, TABLES)), None)
        if wrong is not None:
            raise RunError(f"{wrong}: found a file ending in '{wrong.suffix}', expected {', '.join(TABLES)}")
        read = [read_columns(path) for path in progress(paths, "reading tables")]
        texts = {name: text for _, each in read for name, text in each.items()}
        proposal = propose([{k: x for k, x in table.items() if k not in texts} for table, _ in read])
        files = {COLUMNS: columns_text(proposal)}
        files |= {joint_file(proposal, each): joint_text(each) for each in proposal.joints}
        make_directory(options.out)
        there = [name for name in files if (options.out / name).exists()]
        if there and not options.force:
            print(f"{BY}: {options.out / there[0]}: exists; --force replaces it", file=sys.stderr)
            return 2
        for name, text in files.items():
            write_whole(options.out / name, text.encode())
    except ProposalError as error:
        few = ", ".join(f"'{_shown(name)}' ({text!r})" for name, text in list(texts.items())[:3])
        print(f"{BY}: {options.from_csv[0]}: {error}{few and f'; not numbers: {few}'}", file=sys.stderr)
        return 1
    except (RunError, ConfigError) as error:
        print(f"{BY}: {error}", file=sys.stderr)
        return 1
    print(report(proposal, texts, options.from_csv, options.out))
    return 0


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq init --from-csv`."""
    made = command_parser(
        f"{BY} --from-csv",
        "Propose a column map and joint files for recordings of your own, and list what you have to fill in.",
        _EXAMPLES,
    )
    tables = "tables of one rig (.csv, .csv.gz, .parquet) or directories of them"
    made.add_argument("--from-csv", type=Path, nargs="*", required=True, metavar="FILE", help=tables)
    made.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="directory of the files (.)")
    made.add_argument("--force", action="store_true", help="replace files that are there")
    return made


KEYS: Final = {
    "gear_ratio": "motor turns per joint turn: ratio i of the gear's data sheet",
    "torque_constant_nm_per_a": "motor: KT, or rated torque / rated current; per ampere as recorded (peak or RMS)",
    "rotor_inertia_kgm2": "motor with brake and encoder: J of its data sheet; 1 g cm2 is 1.0e-7",
    "stiffness_nm_per_rad": "gear, joint side: torsional stiffness K2; 1 Nm/arcmin is 3438",
    "damping_nms_per_rad": "gear, joint side: no data sheet has it; 0.001 * stiffness is usual",
    "link_inertia_kgm2": "between gear and torque reference: CAD; 0 for a sensor at the gear's flange",
    "rated_torque_nm": "joint side: of the gear's or joint's data sheet; an error of 0.5 % of it matters",
    "friction": "joint side, a guess that the diagnosis corrects: no-load current * KT * gear ratio; viscous 0 will do",
}
"""Keys of a joint file in its order: what each is, and where a data sheet has it."""


def open_keys(joint: JointProposal) -> dict[str, str]:
    """Return the keys of the joint file that are open, and what each is; a joint with one encoder needs no stiffness."""
    two = {"motor_position_rad", "link_position_rad"} <= set(joint.targets)
    known = {"gear_ratio"} if joint.gear_ratio is not None else set()
    return {key: what for key, what in KEYS.items() if key not in known and (two or key not in ELASTIC)}


def map_lines(joint: JointProposal) -> list[str]:
    """Return the lines of a joint in the column map; one that has ??? is a comment."""
    targets, start = joint.targets, f"j{joint.number}."

    def line(key: str, value: str, hint: str) -> str:
        return f"# {start}{key}: {value}   # {OPEN}: {hint}" if OPEN in value else f"{start}{key}: {value}"

    per_turn = "counts per turn, all edges: data sheet of the encoder"
    lines = [line(key, _text(each.text), per_turn) for key, each in targets.items() if key != DRIVE]
    drive = targets.get(DRIVE)
    if drive is not None and drive.kind == TORQUE:
        product = "gear_ratio * torque_constant_nm_per_a, if the drive computes this torque from its current"
        lines.append(line("current_a", _text(f"{drive.text} / {OPEN}"), product))
    elif drive is not None:
        volts = drive.text if drive.kind == VOLTAGE else f"{OPEN} * {quoted(drive.column)}"
        value = f"{{voltage_v: {_text(volts)}, resistance_ohm: {OPEN}, back_emf_vs_per_rad: {OPEN}}}"
        supply = "" if drive.kind == VOLTAGE else "volts per unit of duty; "
        lines.append(line("drive", value, f"{supply}winding and speed constant: data sheet of the motor"))
    elif "current_a" not in targets:
        lines.append(line("current_a", OPEN, "no current, voltage (j1.drive) or duty found: one is needed"))
    if not any("position" in key or "velocity" in key for key in targets):
        lines.append(line("motor_position_rad", OPEN, "no position or velocity found: one is needed"))
    if "torque_nm" not in targets:
        motor = targets.get("motor_position_rad")
        if motor is not None and "link_position_rad" not in targets:
            angle = quoted(motor.column) if motor.text == motor.column else motor.text
            lines.append(line("link_position_rad", _text(f"{angle} / {OPEN}"), f"{per_turn}, gear_ratio"))
        load = f"{{mass_kg: {OPEN}, lever_m: {OPEN}}}"
        lines.append(line("load", load, "no torque sensor: a known weight, or {inertia_kgm2: 0} for none"))
    return lines


def _text(source: str) -> str:
    return json.dumps(source, ensure_ascii=not source.isprintable())


def joint_file(proposal: Proposal, joint: JointProposal) -> str:
    """Return the name of a joint's file."""
    return "joint.yaml" if len(proposal.joints) == 1 else f"joint_{joint.number}.yaml"


def columns_text(proposal: Proposal) -> str:
    """Return the column map."""
    lines = [
        "# Column map, proposed by jtq init --from-csv (docs/your_data.md). Check units and signs.",
        f"# Put a value for each {OPEN} and remove the # before the line.",
        f"time_s: {_text(proposal.time)}",
        *(line for each in proposal.joints for line in map_lines(each)),
        "",
    ]
    return "\n".join(lines)


def joint_text(joint: JointProposal) -> str:
    """Return the joint file; open keys are comments."""
    lines = [
        f"# Joint {joint.number}, proposed by jtq init --from-csv. SI units.",
        f"# Put a value for each {OPEN} and remove the # before the line.",
        f"name: joint{joint.number}",
    ]
    if joint.gear_ratio is not None:
        lines.append(f"gear_ratio: {joint.gear_ratio:g}   # by the two positions")
    for key, what in open_keys(joint).items():
        value = f"{{coulomb_nm: {OPEN}, viscous_nms_per_rad: {OPEN}}}" if key == "friction" else OPEN
        lines += ["", f"# {what}", f"# {key}: {value}"]
    return "\n".join([*lines, ""])


def report(proposal: Proposal, texts: Mapping[str, str], arguments: Sequence[Path], out: Path) -> str:
    """Return the text for a terminal: columns, notes, what is open, the next command."""
    cells = [("column", "taken for", "unit", "why"), *map(_cells, proposal.columns)]
    cells += [(_shown(column), "-", "-", f"text: {text!r}") for column, text in texts.items()]
    lines = [*table_lines(cells, (0, 1, 2, 3)), "", f"about {proposal.rate_hz:.4g} rows per second"]
    lines += [f"joint {each.number}: {note}" for each in proposal.joints for note in each.notes]
    files = [out / joint_file(proposal, each) for each in proposal.joints]
    open_lines = [line[2:] for each in proposal.joints for line in map_lines(each) if OPEN in line]
    if open_lines:
        lines += ["", f"fill in {out / COLUMNS}:", *(f"  {line}" for line in open_lines)]
    alike: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for path, each in zip(files, proposal.joints, strict=True):
        alike.setdefault(tuple(open_keys(each).items()), []).append(str(path))
    for keys, paths in alike.items():
        missing = table_lines([(f"  {key}", what) for key, what in keys], (0, 1))
        lines += ["", f"fill in {', '.join(paths)}:", *missing]
    numbers = [f"{each.number}=" if len(files) > 1 else "" for each in proposal.joints]
    joints = [f"--joint {n}{shlex.quote(str(path))}" for n, path in zip(numbers, files, strict=True)]
    runs = " ".join(shlex.quote(str(each)) for each in arguments)
    columns, results = shlex.quote(str(out / COLUMNS)), shlex.quote(str(out / "diagnosis"))
    command = f"jtq diagnose {runs} --columns {columns} {' '.join(joints)} --out {results}"
    return "\n".join([*lines, "", "then:", f"  {command}"])


_WIDEST: Final = 40
"""Characters of a column's name in a table of a terminal."""


def _shown(column: str) -> str:
    """Return the name of a column without what controls a terminal, shortened."""
    name = column if column.isprintable() else repr(column)[1:-1]
    return name if len(name) <= _WIDEST else f"{name[: _WIDEST - 3]}..."


def _cells(guess: Guess) -> tuple[str, str, str, str]:
    target = f"j{guess.joint}.{guess.target}" if guess.target != "time_s" else "time_s"
    return _shown(guess.column), target if guess.target else "-", guess.unit or "-", "; ".join(guess.why)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
