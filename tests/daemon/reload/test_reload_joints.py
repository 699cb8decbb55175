"""A reload with another number of joints: refused, the joints named."""

from dataclasses import replace

import pytest

from jtqd.daemon.config import load_config
from jtqd.daemon.reload.files import needs_restart


@pytest.mark.parametrize(("joints", "named"), [(1, ["joint_2"]), (2, []), (4, ["joint_3", "joint_4"])])
def test_another_number_of_joints_needs_a_restart(joints: int, named: list[str]) -> None:
    old = load_config(None)
    every = tuple(replace(old.joints[n % 2], number=n + 1) for n in range(4))
    new = replace(old, joints=(*old.joints, *every[2:])[:joints])
    assert needs_restart(old, new) == named
    assert needs_restart(new, old) == named
