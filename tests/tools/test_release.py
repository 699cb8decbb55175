"""`make release`: the same bytes from two directories, and an SBOM that lists every part with its licence."""

import hashlib
import json
import os
import re
import shutil
import subprocess
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import jtqd
from tests.paths import ROOT
from tests.systemd.systemd_wheels import runtime_distributions

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PINS = dict(re.findall(r"^([\w.-]+)==(\S+)$", (ROOT / "tools/release.txt").read_text(), re.MULTILINE))
VERSIONS = {canonicalize_name(name): version for name, version in PINS.items()}


def test_a_release_takes_fixed_versions_of_all_that_it_is_made_of() -> None:
    project = PROJECT["project"]
    wanted = [*PROJECT["build-system"]["requires"], *project["dependencies"]]
    for each in map(Requirement, wanted + project["optional-dependencies"]["release"]):
        assert each.specifier.contains(VERSIONS[canonicalize_name(each.name)]), each
    assert {canonicalize_name(name) for name in runtime_distributions()} - {"jtqd"} <= set(VERSIONS)


def test_files_of_others_are_in_the_table_of_the_sbom() -> None:
    """A folder of jtqd's packages with a licence of its own holds what somebody else made."""
    packages = [path for path in (ROOT / "src/jtqd").iterdir() if path.is_symlink()]
    found = {
        path.parent.relative_to(ROOT) for each in packages for path in each.resolve().rglob("LICEN[CS]E*")
    }
    table = PROJECT["tool"]["release"]["vendored"]
    assert {Path(pattern).parent for pattern in table} == found
    for pattern, (_, commit, licence) in table.items():
        text = (ROOT / pattern).parent.joinpath("README.md").read_text()
        assert list(ROOT.glob(pattern))
        assert commit in text
        assert f"{licence} licence" in text


def released(
    source: Path, directory: Path, cores: set[int], umask: int, **environment: str
) -> dict[str, bytes]:
    """Content of dist/ that `make release` leaves in a clone of `source` at `directory`."""
    subprocess.run(["git", "clone", "-q", source, directory], check=True)
    clean = {name: text for name, text in os.environ.items() if name not in ("CC", "PYTHONPATH", "CFLAGS")}
    done = subprocess.run(
        ["make", "release"],
        cwd=directory,
        env=clean | {"HOME": str(directory), "DPKG_DEB_COMPRESSOR_TYPE": "gzip"} | environment,
        preexec_fn=lambda: os.sched_setaffinity(0, cores),
        umask=umask,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0 and "NO RELEASE WITHOUT ITS SBOM" in done.stderr:
        pytest.skip("NOT TESTED: cyclonedx-bom cannot be installed")
    assert done.returncode == 0, done.stderr[-3000:]
    return {path.name: path.read_bytes() for path in (directory / "dist").iterdir()}


@pytest.mark.campaign
@pytest.mark.skipif(
    not shutil.which("dpkg-deb") or not shutil.which("git"), reason="NOT TESTED: no dpkg-deb, git"
)
def test_two_directories_give_the_same_bytes(tmp_path: Path) -> None:
    """Directory, home, umask, time zone, language, hashes of strings and number of cores differ."""
    cores = os.sched_getaffinity(0)
    one = released(ROOT, tmp_path / "one", cores, 0o022, TZ="UTC", LC_ALL="C", PYTHONHASHSEED="1")
    other = tmp_path / "a-longer" / "name.of" / "two"
    two = released(
        tmp_path / "one", other, {min(cores)}, 0o077, TZ="Asia/Tokyo", LC_ALL="C.UTF-8", PYTHONHASHSEED="2"
    )
    assert sorted(one) == sorted(two)
    assert [name for name in one if one[name] != two[name]] == []

    names = {name for name in one if name != "SHA256SUMS"}
    endings = {".whl", ".gz", ".deb", ".json"}
    assert {Path(name).suffix for name in names} == endings
    assert one["SHA256SUMS"].decode().splitlines() == [
        f"{hashlib.sha256(one[name]).hexdigest()}  {name}" for name in sorted(names)
    ]
    dist = tmp_path / "one" / "dist"
    for name in names:
        if name.endswith(".whl"):
            content = [
                zipfile.ZipFile(dist / name).read(each) for each in zipfile.ZipFile(dist / name).namelist()
            ]
        elif name.endswith(".gz"):
            with tarfile.open(dist / name) as archive:
                content = [file.read() for each in archive if (file := archive.extractfile(each)) is not None]
        else:
            content = [one[name]]
        assert not [each for each in content if os.fsencode(tmp_path) in each], name

    text = one[f"jtqd-{jtqd.__version__}.cdx.json"].decode()
    check = "import sys; from cyclonedx.schema import SchemaVersion as V; from cyclonedx.validation.json import *; "
    check += (
        "error = JsonStrictValidator(V.V1_6).validate_str(sys.stdin.read()); sys.exit(error and str(error))"
    )
    python = tmp_path / "one/build/release/bin/python"
    done = subprocess.run([python, "-c", check], input=text, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    bom = json.loads(text)
    assert bom["metadata"]["component"]["version"] == jtqd.__version__
    parts = {canonicalize_name(each["name"]): each for each in bom["components"] if each["type"] == "library"}
    assert {name: each["version"] for name, each in parts.items()} == {name: VERSIONS[name] for name in parts}
    assert parts.keys() == {canonicalize_name(name) for name in runtime_distributions()} - {"jtqd"}
    assert all(each["licenses"] for each in bom["components"])
    files = [file for each in bom["components"] for file in each.get("components", ())]
    assert {file["name"] for file in files} >= {
        f"jtqd/{path.relative_to(ROOT)}" for path in (ROOT / "models/kinova_gen3").glob("*.csv.gz")
    }
