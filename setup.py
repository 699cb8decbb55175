"""Compile the extension modules: every .pyx of the packages. All else about the project stands in pyproject.toml.

JTQD_BUILD=checked compiles with bounds checks and assertions, JTQD_BUILD=sanitized with AddressSanitizer and UBSan.
JTQD_BUILD=none compiles nothing: for an editable install of a tree in which `build_ext --inplace` has done it.
"""

import os
import shutil
import sysconfig
from pathlib import Path

from Cython.Build import cythonize
from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.errors import CompileError, LinkError

SOURCES = Path("src") / "jtqd"
SHARED = "jtqd._cython"
"""Cython's own code for memory views, once for all modules: alone it is more than the C of most of them."""
BUILD = os.environ.get("JTQD_BUILD", "release")
OLDEST = (3, 11)
"""Python from which on the modules run: they use its limited API, so that one wheel serves all that follow."""

# -ffp-contract=off: no fused multiply-add, so that every machine computes the same bits
FLAGS = {
    "release": ["-O3", "-g0", "-ffp-contract=off"],
    "checked": ["-O1", "-g", "-ffp-contract=off"],
    "sanitized": [
        "-O1",
        "-g",
        "-ffp-contract=off",
        "-fsanitize=address,undefined",
        "-fno-omit-frame-pointer",
    ],
}
CHECKS = BUILD in ("checked", "sanitized")


class BuildExtensions(build_ext):
    """Compile, or say in one line what is missing."""

    def run(self) -> None:
        """Refuse before the first line of the compiler's own messages where a part of it is missing."""
        compiler = (os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc").split()[0]
        header = Path(sysconfig.get_path("include")) / "Python.h"
        missing = [
            text
            for text, there in (
                (f"a C compiler ({compiler})", shutil.which(compiler) is not None),
                (f"Python's headers ({header})", header.is_file()),
            )
            if not there
        ]
        if missing:
            raise SystemExit(_needs(" and ".join(missing)))
        try:
            super().run()
        except (CompileError, LinkError) as error:
            raise SystemExit(_needs(f"a C compiler that works ({error})")) from None
        if (
            self.inplace
        ):  # beside one for this Python alone, which comes first, a module would never be imported
            for made in (Path(self.get_ext_fullpath(each.name)) for each in self.extensions):
                for other in {*made.parent.glob(f"{made.name.partition('.')[0]}.*.so")} - {made}:
                    other.unlink()


def _needs(what: str) -> str:
    packages = "sudo apt-get install gcc libc6-dev python3-dev"
    return f"error: jtqd is compiled when it is installed and needs {what}; on Debian: {packages}"


def extensions() -> list[Extension]:
    """The module that all share, and one extension module per .pyx, by its place in the packages."""
    if BUILD == "none":
        return []
    flags = FLAGS[BUILD]
    linked = [flag for flag in flags if flag.startswith("-fsanitize")]
    shared = Path("src", *SHARED.split(".")).with_suffix(".c")  # written by Cython into the build directory
    sources = [shared] + [
        source
        for package in sorted(each for each in SOURCES.iterdir() if each.is_dir())
        for source in sorted(package.rglob("*.pyx"))
    ]
    return [
        Extension(
            ".".join(source.relative_to("src").with_suffix("").parts),
            [str(source)],
            define_macros=[("Py_LIMITED_API", f"0x{OLDEST[0]:02X}{OLDEST[1]:02X}0000")],
            py_limited_api=True,
            extra_compile_args=flags,
            extra_link_args=linked,
        )
        for source in sources
    ]


if __name__ == "__main__":
    setup(
        ext_modules=cythonize(
            extensions(),
            nthreads=os.cpu_count() or 0,
            include_path=["src"],
            shared_utility_qualified_name=SHARED,
            build_dir=str(Path("build") / "cython" / BUILD),
            compiler_directives={
                "language_level": 3,
                "boundscheck": CHECKS,
                "initializedcheck": CHECKS,
                "cdivision": True,  # as C and IEEE 754: 1/0 is infinite
                "embedsignature": True,
            },
        ),
        cmdclass={"build_ext": BuildExtensions},
        options={
            "build_ext": {"parallel": os.cpu_count()},
            "bdist_wheel": {"py_limited_api": f"cp{OLDEST[0]}{OLDEST[1]}"},
        },
    )
