"""Cases, or parts of them, that other tests show; and what no test shows, with the reason."""

from __future__ import annotations

from typing import NamedTuple


class Shown(NamedTuple):
    """What is shown of a case, what comes out, and by which tests (path::function)."""

    number: int
    what: str
    outcome: str
    tests: tuple[str, ...]


ELSEWHERE = (
    Shown(
        5,
        "interface removed and created again",
        "exit status 1 with one line; systemd restarts jtqd when the interface is back",
        (
            "tests/daemon/bus/test_daemon_on_vcan.py::test_an_interface_that_is_removed_ends_the_daemon_with_one_line",
            "tests/systemd/test_systemd_boot.py::test_whatever_happens_to_a_service",
        ),
    ),
    Shown(
        6,
        "bus absent at the start",
        "one line, exit status 1; a link that is down is reported at the first receive",
        (
            "tests/daemon/test_jtqd.py::test_unknown_bus",
            "tests/drivers/test_socketcan.py::test_a_link_that_is_down_is_reported_at_the_first_receive",
        ),
    ),
    Shown(
        7,
        "transmit queue full (ENOBUFS)",
        "the frame is dropped and counted in `tx_dropped`; vcan has no queue that could fill",
        ("tests/drivers/test_frame_socket.py::test_enobufs_is_a_dropped_frame_not_an_error",),
    ),
    Shown(
        14,
        "the loop is late for its own SYNC",
        "the slot is skipped and counted in `missed`, no burst",
        ("tests/daemon/loop/test_cycle.py::test_a_stall_of_minutes_is_recorded_and_not_fatal",),
    ),
    Shown(
        15,
        "echo of the own SYNC missing",
        "no input of the cycle is used, `sync_errors`; vcan always echoes",
        ("tests/daemon/loop/test_intake.py::test_without_the_echo_of_sync_nothing_is_used",),
    ),
    Shown(
        27,
        "wrong device at the start",
        "refused with node, object, expected and found value",
        ("tests/drivers/test_boot.py::test_wrong_identity",),
    ),
    Shown(
        28,
        "mapping or transmission type that reads back different",
        "refused at the boot",
        ("tests/drivers/test_boot.py::test_a_value_that_is_not_kept",),
    ),
    Shown(
        31,
        "mode of operation display (6061h) changes",
        "a line for the operator; the estimate uses current and positions in any mode",
        ("tests/daemon/bus/test_service.py::test_another_mode_is_reported_and_the_node_is_used",),
    ),
    Shown(
        32,
        "SDO: aborts, toggle error, late and wrong answers, sizes, flood",
        "each transfer ends with a result or an error, never with a wrong value",
        (
            "tests/drivers/test_sdo.py::test_a_refusal_is_the_servers",
            "tests/drivers/test_sdo.py::test_answers_to_something_else_are_ignored",
            "tests/drivers/test_sdo.py::test_a_toggle_error_ends_the_transfer_and_it_is_repeated",
            "tests/drivers/test_sdo.py::test_a_size_that_is_not_kept_and_one_that_is_too_large",
            "tests/drivers/test_sdo.py::test_silence_is_asked_again_and_then_given_up",
            "tests/slow/test_fuzz_frames.py::test_the_supervisors_path",
        ),
    ),
    Shown(
        34,
        "position counter rolls over at 2^31",
        "the estimate continues",
        ("tests/daemon/loop/test_cycle.py::test_a_position_that_rolls_over_goes_on",),
    ),
    Shown(
        36,
        "rated current 0",
        "refused at the boot",
        ("tests/drivers/test_boot.py::test_a_wrong_value_is_named",),
    ),
    Shown(
        38,
        "loop stopped permanently",
        "the watchdog of systemd restarts the service",
        ("tests/systemd/test_systemd_boot.py::test_installed_started_restarted_hung_and_stopped",),
    ),
    Shown(
        39,
        "a busy process for 0.2 s at a priority above the loop's",
        "slots are skipped and counted in `missed`; published estimates use inputs of their own cycle",
        (
            "tests/daemon/test_jtqd_hog.py::"
            "test_a_processor_hog_costs_counted_cycles_and_nothing_that_is_published_is_stale",
        ),
    ),
    Shown(
        39,
        "garbage collection",
        "it is off in the loop, and no cycle creates objects that need it",
        (
            "tests/daemon/loop/test_loop_garbage.py::test_the_collector_is_off_once_the_loop_is_ready",
            "tests/daemon/loop/test_loop_garbage.py::test_no_cycle_leaves_anything_to_a_collector",
        ),
    ),
    Shown(
        40,
        "disk full, slow recorder",
        "cycles continue; cycles missing in the log are counted",
        (
            "tests/daemon/test_vcan.py::test_a_recorder_that_dies_or_stalls_costs_the_loop_nothing",
            "tests/slow/test_fuzz_soak.py::test_a_minute_of_faults",
            "tests/daemon/logs/test_recover.py::test_full_disk_leaves_the_file_as_it_was",
            "tests/systemd/test_systemd_boot.py::test_whatever_happens_to_a_service",
        ),
    ),
    Shown(
        41,
        "kill -9 while the log is written",
        "repaired at the next start; no complete span is lost",
        (
            "tests/daemon/test_vcan.py::test_a_recorder_that_dies_or_stalls_costs_the_loop_nothing",
            "tests/daemon/logs/test_recover.py::test_killed_between_two_chunks_loses_nothing",
            "tests/daemon/logs/test_recover.py::test_random_damage",
            "tests/slow/test_fuzz_files.py::test_every_kind_of_file",
        ),
    ),
    Shown(
        42,
        "network: NaN, slow, far, corrupt, missing",
        "refused at the start, or not used in the cycle and counted by reason",
        (
            "tests/estimator/test_network.py::test_a_graph_that_is_not_that_of_its_weights_is_refused",
            "tests/estimator/test_network.py::test_unreadable_and_corrupt_files",
            "tests/estimator/test_network.py::test_flipped_bytes_never_give_another_exception",
            "tests/slow/test_fuzz_files.py::test_every_kind_of_file",
            "tests/daemon/loop/test_safety_published.py::test_the_network_that_is_dropped_is_counted_by_its_reason",
            "tests/daemon/loop/test_safety_overrun.py::test_a_network_that_has_become_slow_costs_two_cycles_and_then_only_itself",
        ),
    ),
    Shown(
        43,
        "invalid configuration and joint files",
        "one line that names file, key, found and expected value",
        (
            "tests/daemon/test_config.py::test_mistakes_are_named",
            "tests/daemon/test_config.py::test_files_that_are_no_configuration",
            "tests/models/test_joint_file.py::test_random_garbage_never_gets_past_as_another_exception",
            "tests/slow/test_fuzz_files.py::test_every_kind_of_file",
            "tests/slow/test_fuzz_files.py::test_small_texts_that_explode",
        ),
    ),
    Shown(
        44,
        "EDS files",
        "CiA 306 is met; the lint detects each violation",
        (
            "tests/tools/test_eds.py::test_the_lint_sees_each_breach",
            "tests/slow/test_fuzz_files.py::test_every_kind_of_file",
        ),
    ),
    Shown(
        45,
        "random frames",
        "used inputs have the number of their own cycle; garbage is counted and has no effect",
        (
            "tests/daemon/loop/test_intake.py::test_whatever_is_lost_or_late_what_is_used_is_of_its_own_cycle",
            "tests/daemon/test_jtqd.py::test_garbage_on_the_bus_is_counted_and_changes_nothing",
            "tests/slow/test_fuzz_frames.py::test_50_000_frames",
            "tests/slow/test_fuzz_frames.py::test_a_million_frames",
            "tests/slow/test_fuzz_frames.py::test_minimal_examples",
            "tests/slow/test_fuzz_frames.py::test_the_supervisors_path",
            "tests/slow/test_fuzz_soak.py::test_a_storm",
        ),
    ),
)

NOT_COVERED: dict[int, str] = {}
"""Number of the case: why."""
