"""Tests marked `native` run processes at the pace of this machine's clock; a machine may take its processors away.

A hypervisor counts what it gives to others as stolen time (proc(5), /proc/stat). A loop of 1 kHz cannot keep its deadlines
then, and a test of it says nothing. Such a test is tried again, and when time was stolen from each of its tries it is
skipped, loudly. On a machine that keeps its processors nothing is tried twice: there a failure is a failure.
"""

import time
from contextlib import suppress

import pytest
from _pytest.runner import runtestprotocol

from jtqd.daemon.loop.realtime import stolen_s

TRIES = 3
SHARE = 0.01
"""Stolen part of one processor's time from which on a failure says nothing."""


class NativePace:
    """Runs the tests marked `native`; `stolen_s` and `now_s` are read before and after each try."""

    def __init__(self, stolen_s=stolen_s, now_s=time.monotonic):
        self._stolen_s = stolen_s
        self._now_s = now_s
        self.told = []

    @pytest.hookimpl
    def pytest_collection_modifyitems(self, items):
        """What is judged by how quick it is comes first, while no daemon runs that other tests share."""
        items.sort(key=lambda item: item.get_closest_marker("measures") is None)

    @pytest.hookimpl
    def pytest_runtest_protocol(self, item, nextitem):
        if item.get_closest_marker("native") is None:
            return None
        item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        for report in self._judged(item, nextitem):
            item.ihook.pytest_runtest_logreport(report=report)
        item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
        return True

    def _judged(self, item, nextitem):
        for number in range(1, TRIES + 1):
            stolen_s, began_s = self._stolen_s(), self._now_s()
            reports = runtestprotocol(item, nextitem=nextitem, log=False)
            share = (self._stolen_s() - stolen_s) / max(self._now_s() - began_s, 1e-3)
            failed = next((report for report in reports if report.failed), None)
            if failed is None or share < SHARE:
                return reports
            text = f"{item.nodeid}: try {number} failed while {share:.0%} of a processor were stolen"
            crash = getattr(failed.longrepr, "reprcrash", None)
            self.told.append((text, (crash.message if crash else failed.longreprtext).split("\n", 1)[0]))
            # A daemon or a bench that several tests share may be what broke: the next try begins with new ones.
            with suppress(
                Exception
            ):  # of a process that did not end in time, as little a verdict as the failure
                item.session._setupstate.teardown_exact(None)
            item._initrequest()
        return [self._not_judged(report) for report in reports]

    @staticmethod
    def _not_judged(report):
        if report.failed:
            path, line, _ = report.location
            report.outcome = "skipped"
            why = f"not judged: in each of {TRIES} tries the machine took its processors away (stolen time)"
            report.longrepr = (path, (line or 0) + 1, why)
        return report

    def pytest_terminal_summary(self, terminalreporter):
        if self.told:
            terminalreporter.section("TRIED AGAIN, the machine's processors were taken away", yellow=True)
            for text, what in self.told:
                terminalreporter.line(text, yellow=True)
                terminalreporter.line(f"    {what}")
