"""The bench kernel: what it offers inside (marked socketcan), and the host-side parts that need no kernel."""

import ctypes
import os
import random
import shlex
import shutil
import socket
import struct
import subprocess
import time

import pytest

from jtqd.sim_can.bench_kernel import __main__ as command
from jtqd.sim_can.bench_kernel import build, guest

FRAME = struct.Struct("<IB3x8s")
SOL_CAN_RAW, CAN_RAW_FILTER, CAN_RAW_ERR_FILTER = 101, 1, 2
CAN_ERR_FLAG, CAN_ERR_BUSOFF = 0x2000_0000, 0x0000_0040
time_travel_only = pytest.mark.skipif(
    os.environ.get(guest.TIME_TRAVEL_MARK) != "1", reason="exact times need the bench kernel's time travel"
)


def raw_socket():
    bound = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    bound.settimeout(5.0)
    bound.bind(("vcan0",))
    return bound


# ---- inside


@pytest.mark.socketcan
def test_candump_sees_what_cansend_sends():
    # -L: log format, -T: give up 2 s after the last frame, -n: end after two frames
    dump = ["candump", "-L", "-T", "2000", "-n", "2", "vcan0"]
    with subprocess.Popen(dump, stdout=subprocess.PIPE, text=True) as listening:
        time.sleep(0.5)  # candump has no way to tell that its socket is bound
        subprocess.run(["cansend", "vcan0", "183#11A20B00FF"], check=True)
        subprocess.run(["cansend", "vcan0", "1ABCDEF0#R"], check=True)
        seen, _ = listening.communicate(timeout=10)
    assert [line.split()[1:3] for line in seen.splitlines()] == [
        ["vcan0", "183#11A20B00FF"],
        ["vcan0", "1ABCDEF0#R"],
    ]


@pytest.mark.socketcan
def test_error_frame_reaches_only_a_socket_with_an_error_filter():
    with raw_socket() as with_filter, raw_socket() as without:
        with_filter.setsockopt(SOL_CAN_RAW, CAN_RAW_FILTER, b"")  # no data frames at all
        with_filter.setsockopt(SOL_CAN_RAW, CAN_RAW_ERR_FILTER, struct.pack("=I", CAN_ERR_BUSOFF))
        subprocess.run(["cansend", "vcan0", "20000040#0000000000000000"], check=True)
        subprocess.run(["cansend", "vcan0", "123#55"], check=True)
        can_id, length, _ = FRAME.unpack(with_filter.recv(16))
        assert (can_id, length) == (CAN_ERR_FLAG | CAN_ERR_BUSOFF, 8)
        assert FRAME.unpack(without.recv(16))[0] == 0x123  # the error frame passed it by


@pytest.mark.socketcan
@time_travel_only
def test_a_1_khz_loop_is_exact_while_it_computes():
    libc = ctypes.CDLL(None, use_errno=True)
    pr_set_timerslack, timer_abstime = 29, 1
    assert libc.prctl(pr_set_timerslack, 1, 0, 0, 0) == 0  # 50 us by default, 0 for real-time policies

    class TimeSpec(ctypes.Structure):
        _fields_ = (("s", ctypes.c_long), ("ns", ctypes.c_long))

    grid = (time.monotonic_ns() // 1_000_000 + 2) * 1_000_000
    late = []
    for k in range(2001):
        due = grid + k * 1_000_000
        until = TimeSpec(*divmod(due, 1_000_000_000))
        assert libc.clock_nanosleep(time.CLOCK_MONOTONIC, timer_abstime, ctypes.byref(until), None) == 0
        late.append(time.monotonic_ns() - due)
        sum(range(k % 7 * 1000))  # uneven load: up to 0.1 ms of computing, which must cost no guest time
    # The grid is exact; what is left is that each reading of the clock takes 64 ns in this mode.
    assert min(late) >= 0
    assert max(late) < 1000


@pytest.mark.socketcan
def test_getrandom_answers_and_its_bytes_differ():
    first, second = os.getrandom(32), os.getrandom(32)
    assert len(first) == 32
    assert first != second


@pytest.mark.socketcan
@pytest.mark.skipif(os.environ.get(guest.MARK) != "1", reason="a property of the guest")
def test_guest_is_root_on_an_overlay_with_two_vcans():
    assert os.geteuid() == 0
    assert os.path.isdir(os.environ["HOME"])
    assert os.access(os.environ["HOME"], os.W_OK)
    assert {name for _, name in socket.if_nameindex()} >= {"lo", "vcan0", "vcan1"}
    with open("/proc/mounts") as mounts:
        assert next(line.split()[2] for line in mounts if line.split()[1] == "/") == "overlay"
    for name in ("vcan0", "vcan1"):
        with open(f"/sys/class/net/{name}/tx_queue_len") as length:
            assert length.read().strip() == "1000"


# ---- from the host: one command per boot


@pytest.fixture
def kernel():
    if os.environ.get(guest.MARK) == "1":
        pytest.skip("no guest in the guest")
    try:
        return build.ensure()
    except build.MissingPackagesError as error:
        pytest.skip(str(error))


@pytest.mark.boots
@pytest.mark.usefixtures("kernel")
def test_run_returns_status_and_streams_and_writes_only_to_out_dir(tmp_path, monkeypatch):
    work, out = tmp_path / "work here", tmp_path / "out, written"
    work.mkdir()
    monkeypatch.chdir(work)
    script = (
        'pwd; echo "$WORD" >&2; echo lost >lost; '
        f"echo kept >{shlex.quote(str(out))}/kept; echo $JTQD_IN_BENCH_KERNEL; exit 7"
    )
    word = "a 'quoted'\n$HOME word"
    got = guest.run(["sh", "-c", script], out_dir=out, env={"WORD": word}, timeout_s=120)
    assert got == guest.Result(7, f"{work}\n1\n", f"{word}\n")
    assert (out / "kept").read_text() == "kept\n"
    assert not list(work.iterdir())


@pytest.mark.boots
@pytest.mark.usefixtures("kernel")
def test_time_out_kills_the_guest_and_says_so():
    # time travel with a clock-polling loop: the hang that docs/testing.md warns of
    with pytest.raises(guest.GuestTimeoutError, match=r"did not finish `sh -c .*` within 3 s and was killed"):
        guest.run(["sh", "-c", "echo begun; while :; do :; done"], time_travel=True, timeout_s=3)


# ---- pure parts


@pytest.mark.parametrize(
    ("console", "status", "words"),
    [
        ("x\njtqd: guest set-up failed: mount overlay\n", 0, "its set-up failed: mount overlay"),
        (
            "userspace - ptrace set fp regs failed, errno = 14\nKernel panic - not syncing: died",
            1,
            "FPU registers",
        ),
        ("Kernel panic - not syncing: No working init found.", 1, "kernel panic: No working init found."),
        ("", -9, "ended by SIGKILL"),
        ("", 1, "status 1 before its first line"),
        ("Linux version 6.1\n", 0, "status 0 before the command did"),
    ],
)
def test_a_guest_that_went_down_says_why_in_one_line(console, status, words):
    why = guest.end_of_guest(console, status)
    assert words in why
    assert "\n" not in why


def test_a_kernel_that_does_not_come_up_is_an_error_with_its_reason(monkeypatch):
    monkeypatch.setenv(build.OVERRIDE, shutil.which("false"))
    with pytest.raises(guest.GuestError, match="its kernel ended with status 1 before its first line"):
        guest.run(["true"])


def test_cache_key_changes_with_every_byte_of_the_recipe_and_with_the_version():
    config, version = build.recipe(), "6.1.1-1"
    keys = {build.cache_key(config, version), build.cache_key(config, "6.1.1-2")}
    seed = random.randrange(2**32)
    at = random.Random(seed).randrange(len(config))
    keys.add(build.cache_key(config[:at] + bytes([config[at] ^ 1]) + config[at + 1 :], version))
    assert len(keys) == 3, f"seed {seed}"
    assert build.cache_key(config, version) in keys
    # a byte moved over the border between the two is another build
    assert build.cache_key(b"ab", "c") != build.cache_key(b"a", "bc")


def test_the_recipe_holds_configuration_and_edits(monkeypatch):
    before = build.recipe()
    assert build.CONFIG_FILE.read_bytes() in before
    monkeypatch.setattr(build, "EDITS", (*build.EDITS, build.Edit("a", "b", "c")))
    assert build.recipe() != before


def test_an_edit_fits_exactly_or_is_refused(tmp_path):
    edit = build.Edit("dir/file.c", "size 1;", "size 2;")
    (tmp_path / "dir").mkdir()
    for text, count in (("", 0), ("size 1; size 1;", 2)):
        (tmp_path / edit.file).write_text(text)
        with pytest.raises(build.EditError, match=f"file.c: `size 1;` found {count} times"):
            build.apply_edits(tmp_path, (edit,))
        assert (tmp_path / edit.file).read_text() == text
    (tmp_path / edit.file).write_text("int size 1; // more")
    build.apply_edits(tmp_path, (edit,))
    assert (tmp_path / edit.file).read_text() == "int size 2; // more"


def test_options_with_a_number_have_to_arrive_too():
    assert build.wanted_options("# CONFIG_A=y\nCONFIG_B=y\nCONFIG_C=3\nCONFIG_D=n\n") == [
        "CONFIG_B=y",
        "CONFIG_C=3",
    ]


def test_without_source_package_the_newest_kernel_of_the_same_config_serves(tmp_path):
    config = b"CONFIG_CAN=y\n"

    def store(version, of, age_s):
        place = tmp_path / f"bench-kernel-{build.cache_key(of, version)}"
        place.mkdir()
        (place / "recipe.key").write_text(build.recipe_key(of) + "\n")
        (place / "linux").touch()
        os.utime(place / "linux", (1e9 - age_s, 1e9 - age_s))
        return place / "linux"

    older, newer = store("1", config, 200), store("2", config, 100)
    store("3", b"CONFIG_CAN=n\n", 0)
    assert build.cached(config, "1", tmp_path) == older
    assert build.cached(config, None, tmp_path) == newer
    assert build.cached(config, "3", tmp_path) is None
    assert build.cached(b"", None, tmp_path) is None


def test_missing_packages_are_named_in_order():
    def which(name):
        return None if name in {"flex", "bc"} else f"/usr/bin/{name}"

    def exists(path):
        return path != "/usr/include/libelf.h"

    assert build.missing(build.BUILD, which, exists) == ["flex", "bc", "libelf-dev"]
    assert build.missing(build.BUILD, lambda _: "/x", lambda _: True) == []
    assert build.missing(build.BUILD, lambda _: None, lambda _: False) == [
        *("linux-source-6.1", "gcc", "libc6-dev", "make", "flex", "bison", "bc", "libelf-dev", "xz-utils")
    ]


def test_require_names_the_packages_where_it_may_not_install(monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 65534)
    absent = {"no-such-package": "/no/such/file"}
    with pytest.raises(build.MissingPackagesError, match="apt-get install no-such-package"):
        build.require(absent | {"dash": "sh"})
    build.require({"dash": "sh"})


def test_a_build_asks_once_for_all_that_it_and_the_tests_need(monkeypatch, capsys):
    monkeypatch.setattr(os, "geteuid", lambda: 65534)
    monkeypatch.setattr(build, "find", lambda: None)
    monkeypatch.setattr(build.platform, "machine", lambda: "x86_64")
    absent = {"flex", "candump", "ip"}
    monkeypatch.setattr(build, "find_program", lambda name: None if name in absent else f"/usr/bin/{name}")
    monkeypatch.setattr(build.missing, "__defaults__", (build.find_program, lambda _: True))
    assert command.main(["build"]) == 1
    assert "apt-get install can-utils flex iproute2\n" in capsys.readouterr().err


def test_guest_environment_puts_this_python_first_and_drops_the_hosts_places():
    host = {"PATH": "/opt/x:/usr/bin", "HOME": "/nonexistent", "XDG_RUNTIME_DIR": "/run/user/1", "LANG": "C"}
    got = guest.guest_environment(host, {"LANG": "de", "HOME": "/h"}, time_travel=True)
    assert got["PATH"].split(":")[1:3] == ["/opt/x", "/usr/bin"]
    assert "/usr/sbin" in got["PATH"].split(":")
    assert (got["LANG"], got["HOME"], got[guest.MARK], got[guest.TIME_TRAVEL_MARK]) == ("de", "/h", "1", "1")
    assert "XDG_RUNTIME_DIR" not in got
    assert guest.TIME_TRAVEL_MARK not in guest.guest_environment(host, {}, time_travel=False)


def test_command_script_survives_any_word():
    seed = random.randrange(2**32)
    choose = random.Random(seed)
    words = ["".join(choose.choices("ab '\"$`\\\n;&é*", k=9)) for _ in range(50)]
    script = guest.command_script(["printf", "%s\\0", *words], {"BASH_FUNC_x%%": "() {", "A": words[0]}, "/")
    shown = subprocess.run(["sh", "-c", script], capture_output=True, check=True).stdout
    assert shown.decode().split("\0")[:-1] == words, f"seed {seed}"


def test_guest_memory_lies_where_it_fits(tmp_path):
    assert guest.memory_directory("1K", tmp_path, shared=str(tmp_path.parent)) == str(tmp_path.parent)
    assert guest.memory_directory("1000000G", tmp_path, shared=str(tmp_path.parent)) == str(tmp_path)
    assert guest.memory_directory("1K", tmp_path, shared="/no/such/directory") == str(tmp_path)
