"""Wheels of this project and of what it needs, made from what is installed here: a guest has no network."""

import importlib.metadata
import re
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

from packaging.requirements import Requirement

from tests.paths import ROOT

_LEFT_OUT = (".pyc", "/INSTALLER", "/REQUESTED", "/direct_url.json")


def make_wheels(directory: Path) -> Path:
    """Fill `directory`; returns the project's own wheel."""
    directory.mkdir(parents=True, exist_ok=True)
    for name, distribution in runtime_distributions().items():
        if name != "jtqd":
            _repack(distribution, directory)
    return _own_wheel(directory)


def make_environment(own: Path, directory: Path) -> Path:
    """A virtual environment that will lie at /opt/jtqd, made at `directory`: this project's wheel, and beside it what is
    installed here of all that it needs, which is compiled to byte code already.
    """
    subprocess.run(["/usr/bin/python3", "-m", "venv", "--without-pip", str(directory)], check=True)
    site = next((directory / "lib").glob("python3*")) / "site-packages"
    for name, distribution in runtime_distributions().items():
        if name != "jtqd":
            for top in {file.parts[0] for file in distribution.files or ()} - {"..", "__pycache__"}:
                here = Path(str(distribution.locate_file(top)))
                (shutil.copytree if here.is_dir() else shutil.copy2)(here, site / top)
    subprocess.run(
        [
            *(sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"),
            *("--target", str(site), str(own)),
        ],
        check=True,
    )
    shutil.rmtree(site / "bin", ignore_errors=True)
    for command, module in (("jtqd", "jtqd.daemon.jtqd"), ("jtq", "jtqd.daemon.jtq")):
        script = directory / "bin" / command
        script.write_text(
            f"#!/opt/jtqd/bin/python\nimport sys\nfrom {module} import main\nsys.exit(main())\n"
        )
        script.chmod(0o755)
    return directory


def runtime_distributions() -> dict[str, importlib.metadata.Distribution]:
    """jtqd and all that it needs to run, by name, without extras."""
    found: dict[str, importlib.metadata.Distribution] = {}
    waiting = ["jtqd"]
    while waiting:
        requirement = Requirement(waiting.pop())
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        distribution = importlib.metadata.distribution(requirement.name)
        name = distribution.metadata["Name"].lower()
        if name not in found:
            found[name] = distribution
            waiting += distribution.requires or []
    return found


def _repack(distribution: importlib.metadata.Distribution, directory: Path) -> None:
    tags = re.findall(r"^Tag: (\S+)-(\S+)-(\S+)$", distribution.read_text("WHEEL") or "", re.MULTILINE)
    pythons, abis, platforms = (".".join(dict.fromkeys(column)) for column in zip(*tags, strict=True))
    name = distribution.metadata["Name"].replace("-", "_")
    path = directory / f"{name}-{distribution.version}-{pythons}-{abis}-{platforms}.whl"
    with zipfile.ZipFile(path, "w") as wheel:
        for file in distribution.files or ():
            if not str(file).startswith("..") and not str(file).endswith(_LEFT_OUT):
                wheel.write(file.locate(), str(file))


def copy_sources(copy: Path) -> Path:
    """What the wheel is built from; setuptools leaves its traces beside the sources, so they are copied."""
    copy.mkdir(parents=True)
    for item in ("pyproject.toml", "setup.py", "MANIFEST.in", "README.md", "CHANGELOG.md", "LICENSE"):
        shutil.copy2(ROOT / item, copy / item)
    unwanted = shutil.ignore_patterns("__pycache__", "*.egg-info")
    shutil.copytree(ROOT / "src", copy / "src", symlinks=True, ignore=unwanted)
    packages = [link.name for link in (ROOT / "src" / "jtqd").iterdir() if link.is_symlink()]
    for folder in (*packages, "systemd"):
        shutil.copytree(ROOT / folder, copy / folder, ignore=unwanted)
    # What was translated and compiled here need not be again: setuptools and Cython go by the times of the files, and
    # Cython's own, which came with the development tools, may be younger than what was made before them.
    shutil.copytree(ROOT / "build" / "cython", copy / "build" / "cython", copy_function=shutil.copy)
    library = f"lib.{sysconfig.get_platform()}-{sys.implementation.cache_tag}"
    names = copy / "src" / "jtqd"
    for place in (names, *(names / folder for folder in packages)):
        for module in place.rglob("*.so"):
            target = copy / "build" / library / "jtqd" / module.relative_to(names)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(module, target)
    return copy


def build_wheel(source: Path, directory: Path) -> Path:
    """Build jtqd's wheel from a source tree or an sdist into `directory`, without network."""
    subprocess.run(
        [
            *(sys.executable, "-m", "pip", "wheel", "--quiet", "--disable-pip-version-check"),
            *("--no-deps", "--no-build-isolation", "--wheel-dir", str(directory), str(source)),
        ],
        check=True,
    )
    return next(directory.glob("jtqd-*.whl"))


def _own_wheel(directory: Path) -> Path:
    copy = copy_sources(directory / "source")
    wheel = build_wheel(copy, directory)
    shutil.rmtree(copy)
    return wheel
