"""Units, installer, security rules and the pages about them say the same; what nobody may do, the sources do not do."""

import ast
import configparser
import importlib.metadata
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from jtqd import __version__
from jtqd.daemon.config import load_config
from tests.paths import ROOT
from tests.systemd.systemd_wheels import runtime_distributions

UNITS = ROOT / "systemd"
PACKAGES = ("daemon", "drivers", "estimator", "models", "sim_can", "sysid")
HIGHEST_EXPOSURE = 2.0


def unit(name: str) -> configparser.ConfigParser:
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read(UNITS / name)
    return parser


def page(name: str) -> str:
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


def test_the_page_names_the_directories_of_the_unit() -> None:
    service = unit("jtqd@.service")["Service"]
    text = page("deployment.md")
    assert f"`/run/{service['RuntimeDirectory'].replace('%i', 'INTERFACE')}/jtqd-UID-INTERFACE`" in text
    assert f"`/var/log/{service['LogsDirectory']}`" in text
    assert service["ExecStart"].split("--config ")[1].replace("%I", "INTERFACE") in text


def test_the_unit_grants_what_the_loop_asks_for_and_no_more() -> None:
    service = unit("jtqd@.service")["Service"]
    assert service["Type"] == "notify"
    assert service["RestartPreventExitStatus"] == "2", "a wrong configuration stays wrong"
    assert service["NotifyAccess"] == "all", "the loop, which feeds the watchdog, is not the main process"
    assert int(service["LimitRTPRIO"]) >= 80
    assert service["LimitMEMLOCK"] == "infinity"
    assert "RestrictRealtime" not in service, "it forbids SCHED_FIFO"
    assert "PrivateNetwork" not in service, "it hides the CAN interface"
    assert "PrivateUsers" not in service, "it needs user namespaces, which not every controller's kernel has"
    assert service["RestrictAddressFamilies"].split() == ["AF_CAN", "AF_UNIX"]
    assert service["CapabilityBoundingSet"] == service["AmbientCapabilities"] == ""
    device = "sys-subsystem-net-devices-%i.device"
    assert unit("jtqd@.service")["Unit"]["BindsTo"] == device
    assert unit("jtqd@.service")["Install"]["WantedBy"] == device, (
        "else it does not come back with its device"
    )
    assert unit("can-up@.service")["Install"]["WantedBy"] == device


@pytest.mark.parametrize("name", ["jtqd@.service", "can-up@.service"])
def test_exposure_as_systemd_reckons_it(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    program = shutil.which("systemd-analyze")
    if program is None:
        with capsys.disabled():
            print(f"\nNOT TESTED HERE: exposure of {name}: there is no systemd-analyze (tested in the guest)")
        pytest.skip("no systemd-analyze on this host")
    done = subprocess.run(
        [program, "security", "--offline=true", "--no-pager", str(UNITS / name)],
        capture_output=True,
        text=True,
        check=True,
    )
    last = done.stdout.strip().splitlines()[-1]
    found = re.search(r"for (\S+): ([0-9.]+) ", last)
    assert found is not None, last
    with capsys.disabled():
        print(f"\nsystemd-analyze security {name}: {found[2]} (at most {HIGHEST_EXPOSURE})")
    assert float(found[2]) <= HIGHEST_EXPOSURE


def test_the_installer_installs_every_file_of_the_folder() -> None:
    script = (UNITS / "install.sh").read_text()
    for path in UNITS.iterdir():
        if path.name != "install.sh":
            assert path.name in script, path.name
    subprocess.run(["sh", "-n", str(UNITS / "install.sh")], check=True)
    shown = subprocess.run(
        ["sh", str(UNITS / "install.sh"), "--help"], capture_output=True, text=True, check=True
    ).stdout
    for option in ("--source", "--prefix", "--wheels", "--prepared", "--uninstall", "--purge"):
        assert option in shown
    wrong = subprocess.run(
        ["sh", str(UNITS / "install.sh"), "--frobnicate"], capture_output=True, text=True, check=False
    )
    assert wrong.returncode == 2
    assert "unknown argument --frobnicate" in wrong.stderr


def test_the_installer_asks_the_installed_package() -> None:
    """The lines of Python in the script, run as they stand there."""
    script = (UNITS / "install.sh").read_text()
    answers = [
        subprocess.run(
            [sys.executable, "-c", line], cwd="/", capture_output=True, text=True, check=True
        ).stdout.strip()
        for line in re.findall(r"-c '(import jtqd[^']*)'", script)
    ]
    assert [Path(answers[0]).resolve(), answers[1]] == [ROOT / "models", __version__]


def test_the_installer_gives_a_service_a_budget_for_its_logs(tmp_path: Path) -> None:
    """The line of the script, done to the configuration that ships: it loads, and differs in nothing else."""
    script = (UNITS / "install.sh").read_text()
    (line,) = re.findall(r"^ +(sed .*) >\"\$file\"$", script, re.MULTILINE)
    (half,) = re.findall(r"^half='(.*)'$", script, re.MULTILINE)
    budgets = [
        int(subprocess.run([sys.executable, "-c", half, *names], capture_output=True, check=True).stdout)
        for names in (["can0"], ["can0", "can1", "can2"])
    ]
    assert 20_000 >= budgets[0] >= budgets[1] >= 1_000
    shutil.copytree(ROOT / "models" / "trained", tmp_path / "trained")
    environment = {"budget_mb": str(budgets[0]), "shipped": str(ROOT / "models")}
    made = subprocess.run(
        ["sh", "-c", line], env=environment, capture_output=True, text=True, check=True
    ).stdout
    (tmp_path / "can0.yaml").write_text(made)
    config, shipped = load_config(tmp_path / "can0.yaml"), load_config(None)
    assert config.recording == replace(shipped.recording, budget_mb=float(budgets[0]), keep_run=False)
    assert (config.estimator, config.realtime) == (shipped.estimator, shipped.realtime)


# What the sources must not do --------------------------------------------------------------------------------------------

_BANNED_MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "marshal", "shelve", "jsonpickle"}
_BANNED_CALLS = {"eval", "exec", "compile", "__import__"}
_LOADERS = {"load", "load_all", "unsafe_load", "full_load", "unsafe_load_all", "full_load_all"}


_SUSPICIOUS = re.compile("|".join((*_BANNED_MODULES, *_BANNED_CALLS, "load")))
"""A text without any of these words need not be parsed."""


def offences(source: str) -> list[str]:
    """What in this text could run somebody else's code out of a file."""
    found: list[str] = []
    if not _SUSPICIOUS.search(source):
        return found
    for node in ast.walk(ast.parse(source)):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module]
        found += [f"{node.lineno}: import {name}" for name in names if name.split(".")[0] in _BANNED_MODULES]  # type: ignore[attr-defined]
        if isinstance(node, ast.Call):
            found += _call(node)
    return found


def _call(node: ast.Call) -> list[str]:
    call, keywords = node.func, {each.arg: each.value for each in node.keywords}
    if isinstance(call, ast.Name) and call.id in _BANNED_CALLS:
        return [f"{node.lineno}: {call.id}()"]
    if not isinstance(call, ast.Attribute) or not isinstance(call.value, ast.Name):
        return []
    if call.value.id == "yaml" and call.attr in _LOADERS:
        loader = keywords.get("Loader")
        safe = isinstance(loader, ast.Name) and loader.id == "_Loader"  # models/files.py: a SafeLoader
        return [] if call.attr == "load" and safe else [f"{node.lineno}: yaml.{call.attr}"]
    if call.value.id in ("np", "numpy") and call.attr == "load":
        allowed = keywords.get("allow_pickle")
        if isinstance(allowed, ast.Constant) and allowed.value is True:
            return [f"{node.lineno}: np.load(allow_pickle=True)"]
    if call.value.id == "torch" and call.attr == "load":
        weights = keywords.get("weights_only")
        if not (isinstance(weights, ast.Constant) and weights.value is True):
            return [f"{node.lineno}: torch.load without weights_only=True"]
    return []


def test_no_file_can_bring_code_with_it() -> None:
    found = {
        f"{path.relative_to(ROOT)}:{offence}"
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
        for offence in offences(path.read_text(encoding="utf-8"))
    }
    assert found == set()


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from pickle import loads",
        "import marshal",
        "eval('1')",
        "exec('1')",
        "import yaml\nyaml.load(x)",
        "import yaml\nyaml.load(x, Loader=yaml.Loader)",
        "import yaml\nyaml.unsafe_load(x)",
        "import numpy as np\nnp.load(x, allow_pickle=True)",
        "import torch\ntorch.load(x)",
    ],
)
def test_the_search_finds_what_it_looks_for(source: str) -> None:
    assert offences(source)


def test_a_network_is_opened_only_under_its_hash() -> None:
    """The one place that opens ONNX files takes bytes whose hash has been compared before."""
    opened = [
        path.relative_to(ROOT).as_posix()
        for package in ("daemon", "drivers", "estimator", "models", "sim_can")
        for path in (ROOT / package).rglob("*.py")
        if "InferenceSession" in path.read_text(encoding="utf-8")
    ]
    assert opened == ["estimator/network.py"]
    source = (ROOT / "daemon" / "loop" / "process.py").read_text(encoding="utf-8")
    assert "load_network(method, str(joint.network.path), joint.network.sha256, check)" in source


# Licences ----------------------------------------------------------------------------------------------------------------


def licence_of(distribution: importlib.metadata.Distribution) -> str:
    """SPDX expression where there is one, else the classifiers, else the first line of the licence field."""
    metadata = distribution.metadata
    if "License-Expression" in metadata:
        return metadata["License-Expression"]
    classifiers = [each for each in metadata.get_all("Classifier") or () if each.startswith("License :: ")]
    return ", ".join(classifiers) or (metadata["License"] or "").partition("\n")[0]


def test_every_package_that_runs_with_jtqd_has_a_known_licence() -> None:
    packages = runtime_distributions()
    assert len(packages) > 10
    for name, distribution in packages.items():
        assert re.search(r"MIT|BSD|Apache|PSF|LGPL", licence_of(distribution)), name


def test_only_python_can_is_under_the_lgpl_and_none_under_the_gpl() -> None:
    """It is used as it is, through its public interface, and can be replaced in the environment: the LGPL asks no more."""
    licences = {name: licence_of(each) for name, each in runtime_distributions().items()}
    copyleft = {
        name: licence for name, licence in licences.items() if "GPL" in licence or "General Public" in licence
    }
    assert list(copyleft) == ["python-can"]
    assert "LGPL" in copyleft["python-can"] or "Lesser" in copyleft["python-can"]
