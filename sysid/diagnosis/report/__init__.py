"""HTML report of a diagnosis: one self-contained page, made from the findings alone.

In: `findings.Findings`. Out: HTML. Modules: `words` (what is stated, in the terminal too), `pictures` (over time), `page`.
Imports sysid.report, and the planner for the length of a plan.
"""

from jtqd.sysid.diagnosis.report.page import render

__all__ = ["render"]
