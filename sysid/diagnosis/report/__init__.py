"""The report of a diagnosis: one HTML page from the findings alone, nothing else needed to read it."""

from jtqd.sysid.diagnosis.report.page import render

__all__ = ["render"]
