"""campaign.json: what was done stays done, what was half done is gone, and a directory belongs to one plan."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from jtqd.sysid.campaign.state import DONE, FAILED, PENDING, STOPPED, CampaignDirectory, RunState, StateError
from jtqd.sysid.planner.plan import DEFAULT_LIMITS, Plan, Rest, Run

PLAN = Plan("p", DEFAULT_LIMITS, tuple(Run(name, 1, (Rest(1.0),)) for name in ("a", "b", "c")))
OTHER = Plan("q", DEFAULT_LIMITS, PLAN.runs[:2])
RECIPE = {"kind": "efficiency", "seed": 0}
DONE_STATE = RunState(DONE, attempts=1, rows=5, missed=2, incomplete_by={"sensor": 1}, findings=("x",))


def files(path: Path, name: str, *endings: str) -> None:
    for ending in endings:
        (path / (name + ending)).write_text("x")


def begun(path: Path, plan: Plan = PLAN) -> CampaignDirectory:
    directory = CampaignDirectory(path)
    try:
        directory.begin(plan, RECIPE)
    except StateError:
        directory.close()
        raise
    return directory


def test_a_new_directory_has_every_run_pending(tmp_path):
    directory = begun(tmp_path / "new" / "deep")
    assert [state.status for state in directory.runs.values()] == [PENDING] * 3
    assert json.loads((directory.path / "campaign.json").read_text())["plan_sha256"] == PLAN.sha256
    assert directory.same_recipe(RECIPE) == PLAN
    assert directory.same_recipe({"kind": "validate"}) is None
    directory.close()


def test_done_runs_are_found_again_and_the_others_begin_again(tmp_path):
    directory = begun(tmp_path)
    files(tmp_path, "a", ".csv.gz", ".json", ".mcap")
    directory.put("a", DONE_STATE)
    files(tmp_path, "a@2", ".mcap")  # a second part of its log
    files(tmp_path, "b", ".stopped.mcap")
    files(tmp_path, "b@2", ".stopped.mcap", ".mcap")
    files(tmp_path, "b@x", ".mcap")  # somebody else's
    directory.put("b", RunState(STOPPED, "too hot", attempts=1))
    files(tmp_path, "c", ".csv.gz", ".json")  # killed while it was being kept: no state is "done"
    (tmp_path / "c.part").mkdir()
    files(tmp_path / "c.part", "log", ".mcap")
    directory.close()

    again = begun(tmp_path)
    assert again.runs["a"] == DONE_STATE
    assert again.runs["b"] == again.runs["c"] == RunState()
    left = sorted(file.name for file in tmp_path.iterdir())
    assert left == [
        ".lock", "a.csv.gz", "a.json", "a.mcap", "a@2.mcap", "b@x.mcap", "campaign.json", "plan.yaml",
    ]  # fmt: skip
    again.close()


@pytest.mark.parametrize("missing", [".csv.gz", ".json", ".mcap"])
def test_a_run_whose_files_have_gone_is_not_done(tmp_path, missing):
    directory = begun(tmp_path)
    files(tmp_path, "a", ".csv.gz", ".json", ".mcap")
    directory.put("a", DONE_STATE)
    directory.close()
    (tmp_path / f"a{missing}").unlink()
    again = begun(tmp_path)
    assert again.runs["a"] == RunState()
    assert not list(tmp_path.glob("a.*")), "a part of a run must not be taken for one"
    again.close()


def test_another_plan_is_refused_in_one_line_and_changes_nothing(tmp_path):
    directory = begun(tmp_path)
    files(tmp_path, "a", ".csv.gz", ".json", ".mcap")
    directory.put("a", DONE_STATE)
    directory.close()
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    with pytest.raises(StateError) as caught:
        begun(tmp_path, OTHER)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    for word in (str(tmp_path), "'p'", "'q'", PLAN.sha256[:8], OTHER.sha256[:8], "--out"):
        assert word in message
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_two_campaigns_at_once_in_one_directory_are_refused(tmp_path):
    directory = begun(tmp_path)
    with pytest.raises(StateError, match="another campaign is running"):
        begun(tmp_path)
    directory.close()
    begun(tmp_path).close()


def test_foreign_files_are_refused(tmp_path):
    files(tmp_path, "b", ".csv.gz")
    with pytest.raises(StateError, match=r"found b\.csv\.gz and no campaign\.json"):
        begun(tmp_path)
    assert (tmp_path / "b.csv.gz").exists()
    (tmp_path / "file").write_text("x")
    with pytest.raises(StateError, match="found a file"):
        begun(tmp_path / "file")


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "not JSON"),
        ("\x89\xe0", "not JSON"),
        ("[]", "expected a mapping"),
        ('{"schema": "other"}', "jtq.campaign/1"),
        ('{"schema": "jtq.campaign/1", "name": "p"}', "plan_sha256"),
    ],
)
def test_a_state_that_cannot_be_read_is_refused(tmp_path, text, word):
    (tmp_path / "campaign.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(StateError) as caught:
        CampaignDirectory(tmp_path)
    assert "campaign.json" in str(caught.value)
    assert word in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
    (tmp_path / "campaign.json").unlink()
    CampaignDirectory(tmp_path).close()  # the lock of the refused one is gone


def test_a_plan_file_that_was_edited_is_not_the_one_that_was_begun(tmp_path):
    begun(tmp_path).close()
    (tmp_path / "plan.yaml").write_text(OTHER.to_yaml())
    directory = CampaignDirectory(tmp_path)
    assert directory.same_recipe(RECIPE) is None
    (tmp_path / "plan.yaml").unlink()
    assert directory.same_recipe(RECIPE) is None
    directory.close()


def test_a_crash_between_two_states_leaves_the_old_one_whole(tmp_path, monkeypatch):
    directory = begun(tmp_path)
    files(tmp_path, "a", ".csv.gz", ".json", ".mcap")
    directory.put("a", DONE_STATE)

    def crash(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("os.replace", crash)
    with pytest.raises(KeyboardInterrupt):
        directory.put("b", replace(DONE_STATE, status=FAILED))
    monkeypatch.undo()
    directory.close()
    again = CampaignDirectory(tmp_path)
    assert again.runs["a"] == DONE_STATE
    assert again.runs["b"] == RunState()
    again.close()
