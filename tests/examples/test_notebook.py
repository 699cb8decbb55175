"""examples/first_joint.ipynb: its cells run one after the other, and the diagnosis finds what the data sheet gets wrong.

No Jupyter is needed: cells of plain Python are executed, and the value of a cell's last line is shown as Jupyter does.
"""

from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import Any

import pytest

from tests.paths import ROOT

NOTEBOOK = ROOT / "examples" / "first_joint.ipynb"


def cells() -> list[str]:
    """The code of each cell; no output is kept in the repository."""
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert (notebook["nbformat"], notebook["metadata"]["kernelspec"]["language"]) == (4, "python")
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)
    return ["".join(cell["source"]) for cell in code]


def shown(code: str, names: dict[str, Any]) -> Any:
    """The value of the last line of a cell, None where it is none."""
    parsed = ast.parse(code)
    last = parsed.body.pop() if isinstance(parsed.body[-1], ast.Expr) else None
    exec(compile(parsed, NOTEBOOK.name, "exec"), names)
    if last is None:
        return None
    assert isinstance(last, ast.Expr)
    return eval(compile(ast.Expression(last.value), NOTEBOOK.name, "eval"), names)


@pytest.mark.native
def test_from_a_log_to_the_cause(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    monkeypatch.setenv("MPLBACKEND", "agg")
    names: dict[str, Any] = {"__name__": "__main__"}
    values = [shown(code, names) for code in cells()]
    findings = values[-1]
    cause = max(findings.causes, key=lambda each: each.explained_share)
    assert (findings.verdict, cause.name, cause.joint) == ("cause", "torque_constant", 1)
    found = cause.parameters["torque_constant_nm_per_a"].value
    assert found == pytest.approx(names["joint"].torque_constant_nm_per_a, rel=0.02)
    assert "torque constant" in findings._repr_html_().lower()
