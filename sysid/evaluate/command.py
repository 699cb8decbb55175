"""`jtq evaluate`: every method beside the torque sensor on held-out runs; table, JSON and an HTML report, or a card."""

from __future__ import annotations

import argparse
import datetime as dt
import json
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from jtqd.estimator.command_line import check_installed, command_parser, make_directory
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.files import write_whole
from jtqd.sysid.evaluate.card import (
    BASELINE,
    Card,
    card_html,
    card_lines,
    card_mapping,
    make_card,
    method_of,
    write_png,
)
from jtqd.sysid.evaluate.evaluation import evaluate
from jtqd.sysid.evaluate.inputs import Inputs, JointModels, load_models, read_inputs, take_samples
from jtqd.sysid.evaluate.report import as_mapping, report_html, text_lines
from jtqd.sysid.progress import progress
from jtqd.sysid.runs.channels import RunIssue
from jtqd.sysid.runs.options import add_columns, add_runs
from jtqd.sysid.runs.run_file import RunError

BY: Final = "jtq evaluate"


def main(argv: list[str]) -> int:
    """Evaluate and write; exit status 0 done, 1 failure (a trained-on run included), 2 usage, 3 done with findings."""
    arguments = parser()
    options = arguments.parse_args(argv)
    if options.card and options.outside:
        arguments.error(
            "--card: found --outside as well, expected all runs as RUNS: the card sorts them by load"
        )
    try:
        check_installed("analysis", "matplotlib", "jinja2", "onnx")
        models = load_models(options.models, options.joint)
        make_directory(options.out)
        inputs = read_inputs(options.runs, models, options.columns)
        if not inputs.runs and inputs.findings:
            raise RunError("\n".join(finding.text for finding in inputs.findings))
        outside = Inputs((), (), ())
        if options.outside:
            outside = read_inputs(options.outside, models, options.columns)
        findings = (
            _card(options, models, inputs) if options.card else _report(options, models, inputs, outside)
        )
    except (ValueError, OSError) as error:
        for line in str(error).splitlines() or [type(error).__name__]:
            print(f"{BY}: {line}", file=sys.stderr)
        return 1
    for note in (*inputs.notes, *outside.notes):
        print(f"{BY}: {note}", file=sys.stderr)
    print(
        f"{BY}: wrote {options.out / ('card.html' if options.card else 'evaluation.html')}", file=sys.stderr
    )
    return 3 if findings else 0


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq evaluate`."""
    parser = command_parser(
        BY,
        "Compare all methods with the torque sensor on held-out runs (the paper's section IV).",
        "examples:\n"
        "  jtq evaluate campaigns/validate --models models --out report\n"
        "  jtq evaluate campaigns/validate --models models --outside campaigns/outside --out report --json\n"
        "  jtq evaluate my_runs --models arm --card --out card\n\n"
        "DIR/evaluation.html is the report, DIR/evaluation.json the same for programs. Exit status: 0 done; 1 failure,\n"
        "or a training run of a model was given; 2 usage; 3 done, but a run was left out or there are findings.",
    )
    add_runs(parser)
    parser.add_argument(
        "--models",
        type=Path,
        required=True,
        metavar="DIR",
        help="joint1.yaml (or joint_1.yaml), joint1.onnx (the paper's network), joint1.fused.onnx (ours); so for each joint",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="directory of the report; created if missing"
    )
    parser.add_argument(
        "--joint",
        type=int,
        action="append",
        choices=range(1, 8),
        default=[],
        metavar="N",
        help="only this joint; may be given again (default: every jointN.yaml)",
    )
    parser.add_argument(
        "--outside",
        nargs="+",
        type=Path,
        default=[],
        metavar="RUNS",
        help="runs with more load or warmer than the training runs, to score our method outside its envelope",
    )
    add_columns(parser)
    parser.add_argument(
        "--card",
        action="store_true",
        help="instead of the comparison: accuracy of the best method of each joint by speed, load and temperature, and "
        "what to measure next (card.html, card.json, card_jointN.png)",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON instead of the table")
    return parser


def _report(
    options: argparse.Namespace, models: tuple[JointModels, ...], inputs: Inputs, outside: Inputs
) -> tuple[RunIssue, ...]:
    """Write evaluation.json and evaluation.html; the table or the JSON on standard output. Returns the findings."""
    beyond = {run.sha256: run.name for run in outside.runs}
    for run in inputs.runs:
        if run.sha256 in beyond:  # it would count twice
            raise ConfigError(
                f"--outside {beyond[run.sha256]}: found the same data as in {run.name}, expected other runs"
            )
    result = evaluate(inputs.runs, outside.runs, models)
    findings = (*_unknown_training(models), *inputs.findings, *outside.findings, *result.findings)
    result = replace(result, findings=findings)
    mapping = as_mapping(result)
    text = _written(options.out / "evaluation", mapping, report_html(result, mapping, _made()))
    print(text if options.json else "\n".join(text_lines(result, mapping)))
    return findings


def _card(
    options: argparse.Namespace, models: tuple[JointModels, ...], inputs: Inputs
) -> tuple[RunIssue, ...]:
    """Write card.json, card.html and a picture per joint; the card on standard output. Returns the findings."""
    cards: list[Card] = []
    findings = [*_unknown_training(models), *inputs.findings]
    for each in models:
        method = method_of(each)
        one = replace(each, methods=tuple(dict.fromkeys((BASELINE, method))))
        samples = [
            take_samples(run.name, one, run.table.time_s, run.columns[each.number])
            for run in progress(inputs.runs, f"estimating joint {each.number}")
            if each.number in run.columns
        ]
        card = make_card(samples, each.joint, method)
        if card is not None:
            cards.append(card)
            continue
        text = f"j{each.number}: found no sample in motion with a value: no card"
        findings.append(RunIssue("nothing_to_score", text))
    if not cards:
        raise RunError("\n".join(finding.text for finding in findings))
    page = card_html(cards, {each.number: each.files for each in models}, findings, _made())
    text = _written(options.out / "card", card_mapping(cards, findings), page)
    for card in cards:
        write_png(card, options.out / f"card_joint{card.number}.png")
    lines = [line for card in cards for line in (*card_lines(card), "")]
    lines += [f"{each.kind}: {each.text}" for each in findings]
    print(text if options.json else "\n".join(lines).rstrip())
    return tuple(findings)


def _unknown_training(models: tuple[JointModels, ...]) -> list[RunIssue]:
    return [
        RunIssue(
            "training_runs_unknown",
            f"{name}: found no runs in its metadata, expected names and SHA-256 of its training runs: it is unknown whether "
            "these runs are among them",
        )
        for each in models
        for name in each.without_runs
    ]


def _written(path: Path, mapping: Mapping[str, Any], page: str) -> str:
    """Write path.json and path.html; return the JSON."""
    text = json.dumps(mapping, indent=1, allow_nan=False)
    write_whole(path.with_suffix(".json"), f"{text}\n".encode())
    write_whole(path.with_suffix(".html"), page.encode())
    return text


def _made() -> str:
    return f"{BY}, {dt.datetime.now().astimezone():%Y-%m-%d %H:%M}"


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
