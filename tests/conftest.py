"""Where tests marked `socketcan` run: on the host's vcan0, else all in one boot of the bench kernel.

In the second case the selected tests run in a pytest of their own inside the guest, and every report of that
pytest (pass, failure with its traceback, skip, captured output) becomes the report of the same test here.
See docs/testing.md.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

import pytest

from jtqd.sim_can.bench_kernel import build, guest
from tests.native_pace import NativePace

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # tests that import onnxruntime themselves
FORWARDED = "JTQD_FORWARDED_TESTS"  # set for the guest's pytest: write reports for the host's pytest
REPORTS = "reports.jsonl"  # in the guest's job directory, where writes reach the host at once


def pytest_addoption(parser):
    group = parser.getgroup("bench kernel (tests marked socketcan)")
    group.addoption(
        "--bench-real-time", action="store_true", help="boot the bench kernel without time travel"
    )
    group.addoption(
        "--bench-timeout",
        type=float,
        default=float(os.environ.get("JTQD_BENCH_TIMEOUT", "1440")),
        metavar="S",
        help="wall time for all tests in the bench kernel (default: JTQD_BENCH_TIMEOUT or 1440)",
    )


def pytest_configure(config):
    # A shell that puts a command into the background lets it ignore Ctrl-C, and so would every process started here.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if os.environ.get(guest.MARK) != "1":
        config.pluginmanager.register(SocketCanTests(config), "jtqd-socketcan")
        config.pluginmanager.register(NativePace(), "jtqd-native-pace")
    elif os.environ.get(FORWARDED) == "1":
        config.pluginmanager.register(ReportWriter(config), "jtqd-reports")


class ReportWriter:
    """In the guest: one JSON line per test report."""

    def __init__(self, config):
        self.config = config
        self.file = open(Path(os.environ[guest.JOB_DIRECTORY]) / REPORTS, "a")  # noqa: SIM115 (open for the session)

    def pytest_runtest_logreport(self, report):
        data = self.config.hook.pytest_report_to_serializable(config=self.config, report=report)
        self.file.write(json.dumps(data) + "\n")
        self.file.flush()


class SocketCanTests:
    """On the host: decides where the socketcan tests run, and reports what the guest found."""

    def __init__(self, config):
        self.config = config
        self.waiting = {}  # node id -> item, of the tests to be forwarded
        self.guest = None
        self.skip_reason = None
        self.summary = None
        self.started = 0.0
        self.read_to = 0
        self.reports = {}  # node id -> reports that have arrived
        self.end = None  # why and in which test the guest went down too early

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items):
        chosen = [item for item in items if item.get_closest_marker("socketcan")]
        if not chosen or self.config.option.collectonly:
            return
        if build.ensure_vcan():
            self.summary = f"{len(chosen)} tests on this host's own vcan0"
            return
        self.waiting = {item.nodeid: item for item in chosen}
        # Last, so that no fixture of a module that is left on the host outlives the tests that come after.
        items[:] = [item for item in items if item.nodeid not in self.waiting] + chosen

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item):
        if item.nodeid not in self.waiting:
            return None
        if self.guest is None and self.skip_reason is None:
            self._boot()
        if self.skip_reason is not None:
            item.add_marker(pytest.mark.skip(reason=f"SocketCAN not tested: {self.skip_reason}"))
            return None
        item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        for report in self._reports_of(item):
            item.ihook.pytest_runtest_logreport(report=report)
        item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
        return True

    def pytest_sessionfinish(self):
        if self.guest is not None:
            self.guest.close()

    def pytest_terminal_summary(self, terminalreporter):
        if self.skip_reason is not None:
            terminalreporter.section("SocketCAN NOT TESTED", red=True, bold=True)
            terminalreporter.line(f"{len(self.waiting)} tests skipped: {self.skip_reason}", red=True)
        elif self.summary is not None:
            terminalreporter.line(f"socketcan: {self.summary}")

    def _boot(self):
        real_time = self.config.option.bench_real_time
        count = f"{len(self.waiting)} test{'s' if len(self.waiting) > 1 else ''}"
        self.summary = f"{count} in the bench kernel ({'real time' if real_time else 'time travel'})"
        terminal = self.config.pluginmanager.get_plugin("terminalreporter")
        if terminal is not None:
            terminal.ensure_newline()
            terminal.write_line(f"socketcan: {self.summary}; this host has no usable vcan0")
        capture = self.config.pluginmanager.get_plugin("capturemanager")
        try:
            with capture.global_and_fixture_disabled():  # a build tells its progress
                build.ensure()
                build.require(build.TESTS)
                self.guest = guest.Guest(
                    self._guest_pytest(),
                    time_travel=not real_time,
                    env={FORWARDED: "1", "PYTEST_ADDOPTS": ""},
                    directory=self.config.rootpath,
                )
        except build.MissingPackagesError as error:
            self.skip_reason = str(error)
        self.started = time.monotonic()

    def _guest_pytest(self):
        option = self.config.option
        verbose = ["-" + "v" * option.verbose] if option.verbose > 0 else []
        return [
            *(sys.executable, "-m", "pytest", "-p", "no:cacheprovider", f"--rootdir={self.config.rootpath}"),
            *([f"--config-file={self.config.inipath}"] if self.config.inipath else []),
            *(f"--tb={option.tbstyle}", *verbose),
            *self.waiting,
        ]

    def _reports_of(self, item):
        """The reports of one test, as soon as its teardown has been reported; a failure when it never is."""
        while not self._ended(item.nodeid):
            running = self.guest.running()
            self._read()
            if self._ended(item.nodeid):
                break
            if not running:
                return self._without_end(item, f"the guest went down early, {self.guest.why()}")
            if time.monotonic() - self.started > self.config.option.bench_timeout:
                self.guest.kill()
                return self._without_end(item, "killed at the limit of --bench-timeout")
            time.sleep(0.05)
        return self.reports[item.nodeid]

    def _ended(self, nodeid):
        return any(report.when == "teardown" for report in self.reports.get(nodeid, ()))

    def _read(self):
        try:
            with open(self.guest.job / REPORTS, "rb") as file:
                file.seek(self.read_to)
                lines = file.read()
        except FileNotFoundError:
            return
        lines = lines[: lines.rfind(b"\n") + 1]  # a line that is still being written comes next time
        self.read_to += len(lines)
        for line in lines.splitlines():
            report = self.config.hook.pytest_report_from_serializable(
                config=self.config, data=json.loads(line)
            )
            if isinstance(report.longrepr, list):  # JSON has no tuples, and a skip is one
                report.longrepr = tuple(report.longrepr)
            self.reports.setdefault(report.nodeid, []).append(report)

    def _without_end(self, item, why):
        """A failure of a test that the guest did not finish; the first one shows the guest's output."""
        if self.end is None:
            self.end = f"{why} in {item.nodeid}"
            said = [
                f"--- bench kernel: end of {name} ---\n{text[-4000:]}"
                for name in ("stdout", "stderr", "console.log")
                if (
                    file := self.guest.job / name
                ).exists()  # none where it did not come as far as the command
                and (text := file.read_text(errors="replace").strip())
            ]
            text = "\n".join([f"bench kernel: {why}; this was the first test without a result", *said])
        else:
            text = f"bench kernel: {self.end}; this test has no result"
        common = {
            "nodeid": item.nodeid,
            "location": item.location,
            "keywords": dict.fromkeys(item.keywords, 1),
        }
        return [
            *self.reports.get(item.nodeid, []),
            pytest.TestReport(**common, outcome="failed", longrepr=text, when="call"),
            pytest.TestReport(**common, outcome="passed", longrepr=None, when="teardown"),
        ]
