"""HTML report of a diagnosis: one self-contained page, made from the findings alone.

In: `findings.Findings`. Out: HTML. Modules: `page` (the content), `views` (rows and bars), `words` (sentences), `pictures`.
Imports sysid.report, the effect library, and sysid.campaign for the length of a plan.
"""

from jtqd.sysid.diagnosis.report.page import render

__all__ = ["render"]
