"""What an installation puts where: `jtqd` alone, by wheel, sdist and editable install, beside anybody else's packages.

Environments are made without network, from the packages that are installed here; only python-daemon, whose import name is
`daemon`, is fetched.
"""

import json
import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

import jtqd
from jtqd.daemon import jtq
from tests.paths import ROOT
from tests.systemd.systemd_wheels import build_wheel, copy_sources, make_wheels

PACKAGES = ("daemon", "drivers", "estimator", "models", "sim_can", "sysid")
EXT_SUFFIX = ".abi3.so"
"""Of every Python from 3.11 on."""
DIST_INFO = f"jtqd-{jtqd.__version__}.dist-info"
_HOOK = "import sys, setuptools.build_meta as backend; getattr(backend, sys.argv[1])(sys.argv[2])"


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return copy_sources(tmp_path_factory.mktemp("packaging") / "source")


@pytest.fixture(scope="module")
def wheel(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_wheel(source, tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """jtqd's wheel and one of each package that it needs."""
    directory = tmp_path_factory.mktemp("wheels")
    make_wheels(directory)
    return directory


def expected() -> set[str]:
    files = {
        f"jtqd/{path.relative_to(ROOT).as_posix()}"
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and path.suffix != ".so"
    }
    compiled = {name.removesuffix(".pyx") + EXT_SUFFIX for name in files if name.endswith(".pyx")}
    return files | compiled | {"jtqd/__init__.py", "jtqd/py.typed", f"jtqd/_cython{EXT_SUFFIX}"}


def content(wheel: Path) -> set[str]:
    return {name for name in zipfile.ZipFile(wheel).namelist() if not name.startswith(DIST_INFO)}


def test_every_package_has_its_link() -> None:
    links = {path.name: path.resolve() for path in (ROOT / "src" / "jtqd").iterdir() if path.is_symlink()}
    assert links == {name: ROOT / name for name in PACKAGES}


def test_every_entry_point_exists() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    groups = {"console_scripts": project["scripts"], **project["entry-points"]}
    for group, entries in groups.items():
        for name, value in entries.items():
            assert callable(EntryPoint(name, value, group).load()), f"{group}: {name} = {value}"


def test_one_wheel_serves_every_python_from_the_oldest_on(wheel: Path) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    oldest = project["requires-python"].removeprefix(">=").replace(".", "")
    assert wheel.name.split("-")[2:4] == [f"cp{oldest}", "abi3"]


def test_a_module_for_one_python_alone_does_not_hide_the_new_one(source: Path) -> None:
    """One that was compiled in place before stood first in the order of endings."""
    old = source / "src" / "jtqd" / f"_cython{sysconfig.get_config_var('EXT_SUFFIX')}"
    old.write_bytes(b"")
    command = [sys.executable, "setup.py", "-q", "build_ext", "--inplace"]
    subprocess.run(command, cwd=source, check=True, capture_output=True)
    assert [path.name for path in old.parent.glob("_cython.*.so")] == [f"_cython{EXT_SUFFIX}"]


def test_the_wheel_holds_jtqd_alone_with_all_its_data(wheel: Path) -> None:
    assert content(wheel) == expected()
    for name in (
        "py.typed",
        "drivers/eds/jtqd.eds",
        "models/bench.yaml",
        "models/trained/joint1.onnx",
        "sim_can/bench_kernel/bench_kernel.config",
    ):
        assert f"jtqd/{name}" in expected(), name
    with zipfile.ZipFile(wheel) as archive:
        assert archive.read(f"{DIST_INFO}/top_level.txt").split() == [b"jtqd"]
        assert f"{DIST_INFO}/licenses/LICENSE" in archive.namelist()
        lines = archive.read(f"{DIST_INFO}/METADATA").decode().splitlines()
    assert f"Version: {jtqd.__version__}" in lines


@pytest.mark.campaign
def test_an_editable_install_puts_one_path_there(source: Path, tmp_path: Path) -> None:
    subprocess.run(
        [sys.executable, "-c", _HOOK, "build_editable", str(tmp_path)],
        cwd=source,
        check=True,
        capture_output=True,
    )
    (editable,) = tmp_path.glob("*.whl")
    (name,) = content(editable)
    assert name == f"__editable__.jtqd-{jtqd.__version__}.pth"
    assert zipfile.ZipFile(editable).read(name).decode().split() == [str(source / "src")]
    assert {path.name for path in (source / "src").iterdir()} - {"jtqd.egg-info"} == {"jtqd"}


@pytest.fixture
def shadows(tmp_path: Path) -> Path:
    """A working directory whose modules have the names of our folders."""
    for name in PACKAGES:
        (tmp_path / f"{name}.py").write_text("raise RuntimeError(f'{__file__} was imported')\n")
    return tmp_path


def run(command: list[str | Path], directory: Path, *, path: str = "") -> subprocess.CompletedProcess[str]:
    """In `directory`, with nothing of this process's environment that Python heeds."""
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))
    }
    environment["RUNTIME_DIRECTORY"] = f"{directory}-run"  # another jtqd of this machine is none of ours
    if path:
        environment["PYTHONPATH"] = path
    return subprocess.run(
        command, cwd=directory, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("program", ["jtqd", "jtq"])
def test_modules_of_the_working_directory_stay_out(program: str, shadows: Path) -> None:
    done = run([sys.executable, "-m", f"jtqd.daemon.{program}", "--help"], shadows, path=".")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"usage: {program}")


@pytest.mark.campaign
def test_the_bench_runs_among_modules_with_the_names_of_our_folders(shadows: Path) -> None:
    command = ["-m", "jtqd.daemon.jtqd", "--bus", "sim", "--duration", "2", "--record", "none"]
    done = run([sys.executable, *command], shadows, path=".")
    assert done.returncode == 0, done.stderr


@pytest.mark.campaign
def test_the_sdist_makes_the_same_wheel(source: Path, tmp_path: Path) -> None:
    subprocess.run(
        [sys.executable, "-c", _HOOK, "build_sdist", str(tmp_path)],
        cwd=source,
        check=True,
        capture_output=True,
    )
    (sdist,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        assert not [
            member.name
            for member in archive
            if member.issym() or {"tests", "tools", "validation"} & {*member.name.split("/")}
        ]
        assert f"jtqd-{jtqd.__version__}/systemd/install.sh" in archive.getnames()
    assert content(build_wheel(sdist, tmp_path)) == expected()


def environment(directory: Path) -> Path:
    """The Python of a new virtual environment."""
    subprocess.run([sys.executable, "-m", "venv", str(directory)], check=True)
    return directory / "bin" / "python"


def install(python: Path, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return run(
        [python, "-m", "pip", "--disable-pip-version-check", "install", "-q", *arguments], python.parent
    )


@pytest.fixture(scope="module")
def python_daemon(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Wheels of python-daemon and what it needs."""
    directory = tmp_path_factory.mktemp("python-daemon")
    download = ["download", "-q", "--only-binary", ":all:", "--dest", directory, "python-daemon"]
    done = run([sys.executable, "-m", "pip", "--disable-pip-version-check", *download], directory)
    if done.returncode != 0:
        pytest.skip(f"NOT TESTED: python-daemon cannot be fetched: {done.stderr.strip().splitlines()[-1]}")
    return directory


@pytest.mark.campaign
@pytest.mark.parametrize(
    "order", [("python-daemon", "jtqd"), ("jtqd", "python-daemon")], ids="{0[0]} first".format
)
def test_it_lives_beside_python_daemon(
    order: tuple[str, str], wheels: Path, python_daemon: Path, tmp_path: Path
) -> None:
    python = environment(tmp_path / "venv")
    for name in order:
        done = install(python, "--no-index", "--find-links", wheels, "--find-links", python_daemon, name)
        assert done.returncode == 0, done.stderr
    script = (
        "import daemon, jtqd.daemon.jtqd as ours; print(daemon.DaemonContext.__name__, ours.main.__name__)"
    )
    done = run([python, "-c", script], tmp_path)
    assert (done.stdout, done.stderr) == ("DaemonContext main\n", "")
    assert run([python, "-m", "pip", "uninstall", "-y", "python-daemon"], tmp_path).returncode == 0
    assert run([python, "-c", "import jtqd.daemon.jtqd"], tmp_path).returncode == 0


@pytest.mark.campaign
def test_the_wheel_alone_runs_the_bench_from_an_empty_folder(wheels: Path, tmp_path: Path) -> None:
    python = environment(tmp_path / "venv")
    done = install(python, "--no-index", "--find-links", wheels, "jtqd")
    assert done.returncode == 0, done.stderr
    (site,) = (tmp_path / "venv" / "lib").glob("python3*/site-packages")
    assert not [name for name in PACKAGES if (site / name).exists()]
    empty = tmp_path / "empty"
    empty.mkdir()
    for program in ("jtqd", "jtq"):
        done = run([python.parent / program, "--version"], empty)
        assert done.stdout == f"jtqd {jtqd.__version__}\n"
    for name in jtq.COMMANDS:
        done = run([python.parent / "jtq", name, "--help"], empty)
        assert done.returncode == 0 or "is not installed: pip install 'jtqd[" in done.stderr, done.stderr
    done = run([python.parent / "jtqd", "--bus", "sim", "--duration", "5"], empty)
    assert done.returncode == 0, done.stderr
    assert "RMSE joint 2" in done.stdout
    assert [path.suffix for path in (empty / "logs").iterdir()] == [".mcap"]


def test_what_the_container_file_names_exists() -> None:
    text = (ROOT / "tools" / "Containerfile").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    copied = [
        word
        for line in re.findall(r"^COPY (?!--from)(.*)$", text, re.MULTILINE)
        for word in line.split()[:-1]
    ]
    assert {*PACKAGES, "src", "setup.py", "pyproject.toml"} <= {*copied}
    assert [word for word in copied if not (ROOT / word).exists()] == []
    for extras in re.findall(r"EXTRAS=([\w,]+)", text):
        assert set(extras.split(",")) <= set(project["optional-dependencies"]), extras
    assert json.loads(text.split("ENTRYPOINT ")[1].splitlines()[0])[0] in project["scripts"]
    named = re.search(r"python:(3\.\d+)", text)
    assert named is not None
    assert project["requires-python"] == f">={named[1]}"
