"""The package: the example of its docstring, and a `jtq sim` whose start waits for nothing."""

import doctest
import subprocess
import sys

import jtqd.sim_can


def test_the_command_starts_without_numpy_and_knows_the_profiles_of_plant_files():
    script = (
        "import sys; from jtqd.sim_can.command import PROFILES; assert 'numpy' not in sys.modules; "
        "from jtqd.sim_can import plant_file; assert PROFILES == plant_file.PROFILES"
    )
    subprocess.run([sys.executable, "-c", script], check=True)


def test_the_example_of_the_package():
    failed, attempted = doctest.testmod(jtqd.sim_can)
    assert attempted > 5
    assert failed == 0
