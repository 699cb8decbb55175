"""Mutation testing of what decides on a number that is sent: `make mutants`, or python -m tests.slow.mutants --room NAME.

A mutant is one small change of the source: a comparison, a bound, a sign, a constant, a deleted statement (`transform`). All
mutants of a room are compiled at once into a copy of the tree, each as `changed if its number is chosen else original`
(`build`); a number in memory that all processes of a test share chooses one. First every test runs without a mutant, and
the mutants that it reaches are noted; then each mutant runs the tests that reach it, until one fails (`run`). A mutant that
no test fails on has survived: the tests lack a case, or the change makes no difference (`equivalent.txt`, with the reason).
"""

ROOMS = {
    "estimate_pdo": "daemon/core/estimate_pdo.pyx",
    "status": "daemon/core/status.pyx",
    "intake": "daemon/core/intake.pyx",
    "joint": "daemon/core/joint.pyx",
    "schedule": "daemon/core/schedule.pyx",
    "detection": "estimator/detection.pyx",
    "fusion": "estimator/fusion.pyx",
    "estimator": "estimator/estimator.pyx",
    "observer": "estimator/observer.pyx",
    "losses": "estimator/losses.pyx",
}
"""Name -> compiled source that takes part in deciding on a number that is sent."""
SPAN = 10_000
"""Numbers of mutants: those of room n begin at n SPAN."""
DONE = ("estimate_pdo", "status")
"""Rooms of which every mutant is killed or listed as equivalent."""
TESTS = (
    *(
        "tests/daemon/core",
        "tests/daemon/loop",
        "tests/estimator/test_detection.py",
        "tests/estimator/test_alive_inputs.py",
    ),
    *("tests/examples/test_receivers.py", "tests/daemon/bus/test_own_cob_ids.py"),
)
"""That judge a number that is sent, without a bus and a machine's clock."""
