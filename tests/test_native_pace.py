"""The rule for tests at the machine's own pace: only stolen time excuses a failure, and never silently."""

import re
from itertools import count

import pytest

from tests.native_pace import NativePace
from tests.paths import ROOT

pytest_plugins = ["pytester"]

FAILS_UNTIL = """
    import pytest
    from pathlib import Path

    @pytest.fixture(scope="module")
    def shared():
        count = Path("made")
        count.write_text(count.read_text() + "x" if count.exists() else "x")
        return len(count.read_text())

    @pytest.mark.native
    def test_it(shared):
        assert shared >= {tries}, "late"

    def test_after_it(shared):
        pass
"""


@pytest.mark.parametrize(
    ("tries", "stolen", "outcome"),
    [
        (1, 0.5, {"passed": 2}),
        (2, 0.5, {"passed": 2}),
        (3, 0.5, {"passed": 2}),
        (4, 0.5, {"skipped": 1, "passed": 1}),
        (2, 0.005, {"failed": 1, "passed": 1}),
        (2, 0.0, {"failed": 1, "passed": 1}),
    ],
)
def test_only_stolen_time_excuses(pytester, tries, stolen, outcome):
    reads, clock = count(), count()
    pace = NativePace(lambda: stolen * next(reads), lambda: float(next(clock)))
    pytester.makepyfile(FAILS_UNTIL.format(tries=tries))
    pytester.makeini("[pytest]\nmarkers =\n    native: x")
    result = pytester.inline_run("-p", "no:cacheprovider", plugins=[pace])
    passed, skipped, failed = result.listoutcomes()
    found = {"passed": len(passed), "skipped": len(skipped), "failed": len(failed)}
    assert {name: count for name, count in found.items() if count} == outcome
    excused = min(tries - 1, 3) if stolen >= 0.01 else 0
    assert len(pace.told) == excused
    assert all("test_it: try" in text and "late" in what for text, what in pace.told)


def test_a_fixture_that_cannot_be_torn_down_ends_nothing(pytester):
    pytester.makepyfile(
        """
        import pytest
        count = []

        @pytest.fixture(scope="module")
        def shared():
            count.append(1)
            yield
            assert len(count) > 1, "the process did not end in time"

        @pytest.mark.native
        def test_it(shared):
            assert len(count) > 1

        def test_after_it(shared):
            pass
        """
    )
    pytester.makeini("[pytest]\nmarkers =\n    native: x")
    reads, clock = count(), count()
    pace = NativePace(lambda: 0.5 * next(reads), lambda: float(next(clock)))
    result = pytester.inline_run("-p", "no:cacheprovider", plugins=[pace])
    assert [len(each) for each in result.listoutcomes()] == [2, 0, 0]
    assert len(pace.told) == 1


def test_an_unmarked_test_is_never_tried_again(pytester):
    clock = count()
    pytester.makepyfile("def test_it():\n    assert False")
    pace = NativePace(lambda: float(next(clock)), lambda: float(next(clock)))
    result = pytester.inline_run("-p", "no:cacheprovider", plugins=[pace])
    assert len(result.listoutcomes()[2]) == 1
    assert pace.told == []


def test_what_is_judged_by_how_quick_it_is_comes_first(pytester):
    pytester.makeini("[pytest]\nmarkers = measures")
    pytester.makepyfile("import pytest\ndef test_a(): pass\n@pytest.mark.measures\ndef test_b(): pass")
    result = pytester.inline_run("-p", "no:cacheprovider", plugins=[NativePace()])
    assert [each.nodeid.split("::")[1] for each in result.listoutcomes()[0]] == ["test_b", "test_a"]


def test_the_mark_of_a_lane_stands_in_the_file_of_its_tests():
    """The Makefile gives a lane the files that name its mark: a test with a mark from elsewhere would be in none."""
    named = re.compile(r"\bmark\.(socketcan|boots|native|measures)\b|getattr\(pytest\.mark")
    elsewhere = [path for path in (ROOT / "tests").rglob("*.py") if not path.name.startswith("test_")]
    assert [path.name for path in elsewhere if named.search(path.read_text())] == []
