"""The package's public names: the examples of its docstring, and what its import costs."""

from __future__ import annotations

import doctest
import subprocess
import sys

import jtqd.estimator


def test_the_examples_of_the_docstring() -> None:
    failed, attempted = doctest.testmod(jtqd.estimator)
    assert attempted > 10
    assert failed == 0


def test_every_public_name_exists() -> None:
    for name in jtqd.estimator.__all__:
        assert hasattr(jtqd.estimator, name), name
    assert not hasattr(jtqd.estimator, "no_such_name")


def test_the_import_is_light() -> None:
    """A process that needs one module of the package pays for that one; a network's runtime only when it loads one."""
    script = (
        "import sys, jtqd.estimator; assert 'numpy' not in sys.modules; "
        "from jtqd.estimator import make_estimator; assert 'onnxruntime' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
