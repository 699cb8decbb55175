"""The page in the browser: numbers of the log, who may ask, pages that do not read, and what Chromium draws."""

import json
import resource
import select
import socket
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from jtqd.daemon.live import NEEDED, Address, process, web
from jtqd.daemon.live.gateway import Gateway
from jtqd.daemon.live.page_events import PageEvents, Samples
from jtqd.daemon.live.reading import Daemon, Watch, content
from jtqd.daemon.recording import messages
from jtqd.daemon.recording.messages import CycleMessages
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.cycle_record import SHADOW, SHADOW_FIELDS, Ring, layout_of
from jtqd.daemon.shared.events import FILE, Notices
from jtqd.daemon.shared.runtime_dir import write_about
from jtqd.daemon.shared.snapshot import WORK_BIN_NS, Snapshot
from tests.daemon.cli.status_daemon import SAMPLE, described
from tests.daemon.live import browser
from tests.daemon.live.browser import Browser
from tests.daemon.live.live_view_helpers import LiveProcess, asked, request_of
from tests.daemon.recording.recorder_bench import DEFINITIONS, START_NS, record_of
from tests.daemon.snapshots import EstimateWriter

_LAYOUT = layout_of(2, shadow=True)
_NAN = float("nan")
ONE = (12.34, 0.25, _NAN, 12.0, _NAN, 12.1, 0x1237, 2, 0, 15, 0, 11.84, 0.0, _NAN, _NAN)
TWO = (_NAN, _NAN, _NAN, _NAN, _NAN, _NAN, 0x1237, 4, 0, 1, 0, _NAN, 0.0, _NAN, _NAN)


def shadow_values(index, number):
    """The block of a joint's shadow methods: all but the last method, every field another function of the cycle."""
    quantities = [number * 100.0 + index % 100 + field / 16 for field in range(12)]
    return (*quantities, *(_NAN,) * 4, 2, 2, 2, 0)


def record_with_shadow(index, statuses=(2, 2)):
    record = bytearray(_LAYOUT.size)
    record[: cr.PAIR.tail_offset] = record_of(index, statuses=statuses)[:-8]
    for n in range(2):
        SHADOW.pack_into(record, _LAYOUT.shadow_offset + n * SHADOW.size, *shadow_values(index, n + 1))
    cr.TAIL.pack_into(record, _LAYOUT.tail_offset, index)
    return bytes(record)


class Running:
    """A runtime directory as a daemon leaves it; `feed` puts cycles at 1 kHz."""

    def __init__(self, directory):
        self.directory = directory
        self.ring = Ring(directory / "ring", 4096, _LAYOUT.size)
        self.snapshot = Snapshot(directory / "snapshot", 0.001, 0.5)
        self.notices = Notices(directory / FILE)
        write_about(directory, described("vcan7"))
        self.count, self._writer = 0, EstimateWriter(self.snapshot)
        self.snapshot.work[12], self.snapshot.work[40], self.snapshot.late[2] = 900, 3, 903
        self._stop = threading.Event()

    def cycle(self):
        index, self.count = self.count, self.count + 1
        self.ring.append(record_with_shadow(index))
        if index % 8 == 0:
            now = time.monotonic_ns(), time.time_ns()
            self._writer.write(
                index,
                17,
                now[1],
                (ONE, TWO),
                sync_monotonic_ns=now[0] + 60_000_000_000,
                measured=(SAMPLE, SAMPLE),
            )

    def _feed(self):
        due = time.monotonic()
        while not self._stop.is_set():
            self.cycle()
            due = max(due + 0.001, time.monotonic() - 0.1)
            if due - time.monotonic() > 0.004:
                time.sleep(due - time.monotonic())

    def __enter__(self):
        self._thread = threading.Thread(target=self._feed, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()


def answered(port, data):
    """The whole answer to these bytes."""
    with socket.create_connection(("127.0.0.1", port), timeout=10) as client:
        client.sendall(data)
        return b"".join(iter(lambda: client.recv(65_536), b""))


@pytest.fixture(scope="module")
def live(tmp_path_factory):
    """A process that serves, and what it reads, which goes on."""
    with (
        Running(tmp_path_factory.mktemp("page")) as running,
        LiveProcess(running.directory, shadow=True) as served,
    ):
        yield SimpleNamespace(running=running, port=served.port, process=served)


def events_of(data):
    """(name, content) of whole events."""
    for part in data.split(b"\n\n")[:-1]:
        name, text = part.split(b"\n")
        yield name.removeprefix(b"event: ").decode(), json.loads(text.removeprefix(b"data: "))


class Page:
    """One open stream of events."""

    def __init__(self, port, buffer_size=None):
        self.socket = socket.socket()
        self.socket.settimeout(10)
        if buffer_size:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer_size)
        self.socket.connect(("127.0.0.1", port))
        self.socket.sendall(b"GET /events HTTP/1.1\r\nHost: localhost:1\r\n\r\n")
        self._data = b""

    def read(self, seconds):
        """All that came, until now and for so long."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            if select.select([self.socket], [], [], left)[0]:
                self._data += self.socket.recv(262_144)
        return self._data

    def until(self, enough):
        """The events as soon as there are enough of both names."""
        end = time.monotonic() + 30.0
        while True:
            head, _, data = self.read(0.05).partition(b"\r\n\r\n")
            found = list(events_of(data))
            if all(enough(name, sum(each == name for each, _ in found)) for name in ("samples", "state")):
                break
            assert time.monotonic() < end, found
        assert head.startswith(b"HTTP/1.1 200 "), head
        assert b"\r\nContent-Type: text/event-stream\r\n" in head
        return found


# ---- the numbers ----


def test_samples_are_the_numbers_of_the_log():
    records = [record_with_shadow(n, statuses=(4 if n == 140 else 2, 2)) for n in range(100, 200)]
    samples = Samples(2, shadow=True)
    samples.take(records)
    found = samples.content()
    assert found["cycle"] == [100, 120, 140, 160, 180]
    assert found["time_s"] == pytest.approx(
        [(START_NS + n * 1_000_000) * 1e-9 for n in found["cycle"]], abs=1e-6
    )
    logged = CycleMessages(2, shadow=True)
    names = {each.number: each for each in messages.topics_of(2, shadow=True)}
    for at, index in enumerate(found["cycle"]):
        block = logged.block(records[index - 100], index, START_NS, flags=15, sync_counter=1, frames=2)
        for number, payload in logged.payloads(block):
            topic = names[number]
            if not topic.name.startswith("/joint/"):
                continue
            message = DEFINITIONS[topic.schema].decode(payload)
            columns = found["joints"][int(topic.name.split("/")[2]) - 1]
            shown = {name: values[at] for name, values in columns.items() if name in message}
            assert shown == {
                name: None if message[name] != message[name] else message[name] for name in shown
            }
            assert len(shown) == (4 if topic.name.endswith("state") else 12)
    assert found["joints"][0]["status"] == [2, 2, 4, 2, 2]
    assert (
        found["joints"][1]["efficiency_torque_nm"][0]
        == shadow_values(100, 2)[SHADOW_FIELDS.index("efficiency_torque_nm")]
    )
    assert samples.content()["cycle"] == [], "each cycle once"


def test_events_come_20_times_a_second_and_the_state_five_times(tmp_path):
    running = Running(tmp_path)
    running.cycle()
    events, found = PageEvents(tmp_path, 2, shadow=True), []
    for ms in range(0, 1000, 20):
        found += events_of(events.take([], 10**9 + ms * 1_000_000))
    names = [name for name, _ in found]
    assert (names.count("samples"), names.count("state")) == (20, 5)


def test_the_state_is_that_of_jtq_status_with_the_histograms(tmp_path):
    running = Running(tmp_path)
    running.cycle()
    name, state = list(events_of(PageEvents(tmp_path, 2, shadow=True).take([], 10**9)))[-1]
    assert name == "state"
    page = state.pop("page")
    expected = json.loads(json.dumps(content(Watch(Daemon(tmp_path, described("vcan7"))).read())))
    for each in (state, expected):
        each.pop("started")
    assert state == expected
    assert page["bin_us"] == WORK_BIN_NS / 1000
    assert page["period_us"] == 1000
    assert page["work"] == [900 if n == 12 else 3 if n == 40 else 0 for n in range(41)]
    assert page["late"] == [0, 0, 903]
    assert state["joints"][0]["ratios"] == pytest.approx({"sensor": abs(12.34 - 11.84) / (3 * 0.25)})
    assert state["joints"][1]["ratios"] == {}


def test_a_daemon_that_has_not_described_itself_has_samples_alone(tmp_path):
    running = Running(tmp_path)
    (tmp_path / "about.json").unlink()
    events = PageEvents(tmp_path, 2, shadow=True)
    found = list(events_of(events.take([record_with_shadow(0)], 10**9)))
    assert [(name, each["cycle"]) for name, each in found] == [("samples", [0])]
    assert running.count == 0


# ---- who may ask ----


def head(*headers, method="GET", path="/"):
    return "\r\n".join((f"{method} {path} HTTP/1.1", *headers, "", "")).encode()


def status_of(answer):
    return int(answer.split(b" ", 2)[1])


_NAMES = frozenset(("localhost", "arm-7", "arm-7.local"))


@pytest.mark.parametrize(
    "host",
    ["127.0.0.1:8765", "localhost", "LOCALHOST:80", "[::1]:8765", "192.0.2.7", "arm-7:9", "arm-7.local"],
)
def test_hosts_that_are_this_machine(host):
    assert web.obstacle(web.request_of(head(f"Host: {host}")), _NAMES) == ""


@pytest.mark.parametrize(
    "headers",
    [
        (),
        ("Host: evil.example",),
        ("Host: arm-7.evil.example:8765",),
        ("Host: 127.0.0.1.evil.example",),
        ("Host: localhost", "Host: evil.example"),
        ("Host: localhost:80@evil.example",),
        ("Host: ",),
        ("Host: localhost", "Origin: http://evil.example"),
        ("Host: localhost:8765", "Origin: http://localhost:1"),
        ("Host: localhost", "Origin: null"),
        ("Host: localhost", "Origin: https://localhost"),
    ],
)
def test_hosts_and_origins_of_others_get_nothing(headers):
    for path in ("/", "/events", "/page.js", "/nothing"):
        answer = web.answer(web.request_of(head(*headers, path=path)), _NAMES)
        assert status_of(answer) == 403
        assert b"uPlot" not in answer


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/", 200),
        ("HEAD", "/", 200),
        ("GET", "/page.js?x=1", 200),
        ("HEAD", "/events", 200),
        ("POST", "/", 405),
        ("OPTIONS", "/events", 405),
        ("GET", "/../web.py", 404),
        ("GET", "/uplot/../../../jtqd.py", 404),
        ("GET", "/%2e%2e/web.py", 404),
        ("GET", "/page", 404),
        ("HEAD", "/page", 404),
    ],
)
def test_what_is_answered(method, path, status):
    origin = "Origin: http://localhost:8765"
    answer = web.answer(
        web.request_of(head("Host: localhost:8765", origin, method=method, path=path)), _NAMES
    )
    assert status_of(answer) == status
    assert answer.endswith(b"\r\n\r\n") == (method == "HEAD")


@pytest.mark.parametrize(
    "data", [b"\0\1\r\n\r\n", b"GET /\r\n\r\n", b"GET http://a/ HTTP/1.1\r\n\r\n", b"GET / HTTP/2\r\n\r\n"]
)
def test_what_is_no_request(data):
    with pytest.raises(ValueError, match="expected a request"):
        print(web.request_of(data))


def test_no_name_of_the_machine_is_a_pattern():
    assert web.local_names("192.0.2.7") == {
        "localhost",
        "192.0.2.7",
        socket.gethostname().lower(),
        f"{socket.gethostname().lower()}.local",
    }


# ---- the process ----


def test_over_the_socket_the_same_refusals(live):
    assert status_of(asked(live.port, "/events", host="evil.example")) == 403
    assert status_of(asked(live.port, "/", "Origin: http://evil.example")) == 403
    upgrade = "Sec-WebSocket-Protocol: foxglove.sdk.v1", "Upgrade: websocket", "Connection: Upgrade"
    assert status_of(asked(live.port, "/", *upgrade, host="evil.example")) == 403
    assert status_of(asked(live.port, "/", method="PUT")) == 405
    assert status_of(answered(live.port, b"\x16\x03\x01\r\n\r\n")) == 400


def test_what_it_does_not_read_is_answered_too(live):
    assert status_of(answered(live.port, head(f"Cookie: {'x' * 20_000}", "Host: localhost"))) == 431
    long = head("Host: localhost", "Content-Length: 4000000", method="POST") + bytes(4_000_000)
    assert status_of(answered(live.port, long)) == 405
    no_key = "Upgrade: websocket", "Sec-WebSocket-Protocol: foxglove.sdk.v1"
    assert status_of(answered(live.port, head("Host: localhost", *no_key))) == 400
    assert status_of(answered(live.port, head("Host: localhost", no_key[1]))) == 200


def test_connections_that_do_not_ask_take_no_place_of_those_that_do(tmp_path):
    """With as many as it may have open files; a traceback fails the process."""
    with Running(tmp_path) as running, LiveProcess(running.directory, shadow=True) as served:
        resource.prlimit(served.process.pid, resource.RLIMIT_NOFILE, (256, 256))
        silent = [socket.create_connection(("127.0.0.1", served.port), timeout=10) for _ in range(400)]
        assert status_of(asked(served.port, "/")) == 200
        assert len(list(Path(f"/proc/{served.process.pid}/fd").iterdir())) < 200
        for each in silent:
            each.close()
    assert "Too many open files" not in served.errors


def test_the_page_is_small_comes_from_here_alone_and_states_so(live):
    paths = [
        "/",
        "/page.css",
        "/page.js",
        "/uplot/uPlot.min.css",
        "/uplot/uPlot.iife.min.js",
        "/uplot/LICENSE",
    ]
    answers = [asked(live.port, path) for path in paths]
    assert [status_of(each) for each in answers] == [200] * 6
    bodies = [each.partition(b"\r\n\r\n")[2] for each in answers]
    assert sum(map(len, bodies)) < 150_000
    assert b"Leon Sorokin" in bodies[-1]
    for name in (
        b"Content-Security-Policy: default-src 'none'; script-src 'self';",
        b"nosniff",
        b"same-origin",
    ):
        assert name in answers[0]
    for body in bodies[:3]:
        assert b"//" not in body.replace(b"<!doctype", b"").split(b"\n")[0]
        assert b"https:" not in body
        assert b"http:" not in body


def test_a_page_that_does_not_read_loses_events_and_others_do_not():
    gateway, event = Gateway(Address(port=0), None), b"event: state\ndata: 1" + b" " * 65_536 + b"\n\n"
    stuck, good = [Page(gateway.port, buffer_size) for buffer_size in (4096, None)]
    end = time.monotonic() + 30.0
    while len(gateway._pages) < 2:
        assert time.monotonic() < end
    for _ in range(100):
        gateway.publish(event)
        good.read(0.002)
    waiting = [each.transport.get_write_buffer_size() for each in gateway._pages]
    while good.read(0.01).count(event) < 100:
        assert time.monotonic() < end
    gateway.stop()
    assert max(waiting) < 500_000
    stuck.socket.close()


def test_a_gateway_without_a_page_answers_in_one_line():
    gateway = Gateway(Address(port=0), None, page=False)
    with socket.create_connection(("127.0.0.1", gateway.port), 5.0) as asking:
        asking.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        answer = b"".join(iter(lambda: asking.recv(4096), b""))
    gateway.stop()
    assert answer.startswith(b"HTTP/1.1 404 ")
    assert answer.count(b"\n", answer.index(b"\r\n\r\n") + 4) == 1


def test_ten_pages_get_the_same_numbers(live):
    before = (live.running.directory / "snapshot").read_bytes()[:8]
    pages = [Page(live.port) for _ in range(10)]
    found = pages[0].until(lambda name, count: count >= 4 * (1 + (name == "samples")))
    seen = [dict(page.until(lambda name, count: count >= 1)) for page in pages]
    cycles = [n for name, each in found if name == "samples" for n in each["cycle"]]
    assert cycles == sorted(set(cycles))
    assert all(n % 20 == 0 for n in cycles[1:]), "the first may be within its 20 ms"
    assert len(cycles) >= 10
    assert all(each["state"]["joints"][0]["torque_nm"] == 12.34 for each in seen)
    assert all(each["state"]["joints"][1]["status"] == "stale" for each in seen)
    assert live.process.shared()["snapshot"] == live.process.shared()["ring"] == "r--s"
    assert (live.running.directory / "snapshot").read_bytes()[:8] == before
    for page in pages:
        page.socket.close()


def test_without_foxglove_there_is_the_page_and_what_to_install(tmp_path, monkeypatch):
    running = Running(tmp_path)
    monkeypatch.setattr(process, "installed", lambda: False)
    where, serve = process.begin(request_of(tmp_path, shadow=True))
    assert NEEDED in where
    port = int(where.split()[0].rpartition(":")[2])
    stop = SimpleNamespace(requested=False)
    thread = threading.Thread(target=serve, args=(stop,))
    thread.start()
    try:
        assert status_of(asked(port, "/")) == 200
        answer = asked(port, "/", "Upgrade: websocket", "Sec-WebSocket-Protocol: foxglove.sdk.v1")
        assert status_of(answer) == 400
        assert b"jtqd[live]" in answer
        running.cycle()
        Page(port).until(lambda name, count: count >= 1 or name == "state")
    finally:
        stop.requested = True
        thread.join()


# ---- the browser ----


@pytest.fixture(scope="module")
def chromium(tmp_path_factory):
    if browser.CHROMIUM is None:
        pytest.skip(
            "NO BROWSER, THE PAGE IS NOT TRIED: install Debian's package chromium (make test does, as root)"
        )
    with Browser(Path(tmp_path_factory.mktemp("chromium")) / "profile") as opened:
        yield opened


@pytest.fixture
def page(live, chromium):
    """The page at 1280 px in light colours, with points."""
    chromium.errors.clear()
    chromium.open(f"http://127.0.0.1:{live.port}/")
    chromium.until("typeof cards !== 'undefined' && cards[1]?.columns.time_s?.length > 20")
    chromium.value("windowS = 5")
    return chromium


_INK = """(selector) => {
    const canvas = document.querySelector(selector + " canvas");
    const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
    const wanted = getComputedStyle(document.documentElement).getPropertyValue("--estimate").trim();
    const [r, g, b] = [1, 3, 5].map((at) => parseInt(wanted.slice(at, at + 2), 16));
    let count = 0;
    for (let n = 0; n < pixels.length; n += 4) {
        const off = Math.abs(pixels[n] - r) + Math.abs(pixels[n + 1] - g) + Math.abs(pixels[n + 2] - b);
        count += off < 12 && pixels[n + 3] > 200;
    }
    return count;
}"""


def test_chromium_draws_it_at_two_widths_in_both_colours(page):
    for width, scheme in ((1280, "light"), (1280, "dark"), (390, "light"), (390, "dark")):
        page.show(width, scheme=scheme)
        for place in (".trace", ".ratio", "#histogram"):
            page.until(f"({_INK})('{place}') > 100")
        assert page.value("document.documentElement.scrollWidth") == width
        outside = "(each) => each.getBoundingClientRect().right > innerWidth"
        of = "[...document.querySelectorAll('td, dd, dt, h2, button, select')]"
        assert page.value(f"{of}.filter({outside}).length") == 0
    assert page.errors == []


def test_its_numbers_are_those_of_the_snapshot_and_of_the_ring(page, live):
    assert page.value("document.querySelector('.torque').innerText").split() == ["+12.34", "±", "0.25", "Nm"]
    assert page.value("document.querySelectorAll('.torque')[1].innerText").strip() == "no torque"
    cells = "(row) => row.innerText.split(/\\s+/)"
    rows = f"(each) => [...each.querySelectorAll('tbody tr')].map({cells})"
    one, two = page.value(f"[...document.querySelectorAll('article')].map({rows})")
    assert one[0][:4] == ["estimate", "+12.34", "0.25", "+0.50"]
    assert one[1][:2] == ["sensor", "+11.84"]
    assert two[0][1] == "–", "stale: no torque"
    assert page.value("document.getElementById('verdict').innerText") == "✕Joint 2 stale"
    assert page.value("document.title").startswith("✕ jtqd vcan7")
    cycle, torque, ratio = page.value(
        "[1, 'torque_nm', 'ratio'].map((key) => key === 1 ? Math.round((cards[0].columns.time_s.at(-1) - "
        f"{START_NS // 10**9}) * 1000) : cards[0].columns[key].at(-1))"
    )
    values = cr.joint_of(record_of(cycle), 1)
    assert torque == values.torque_nm
    assert ratio == pytest.approx((values.torque_nm - values.reference_nm) / values.sigma_nm)


def test_a_shadow_method_that_comes_later_is_drawn_too(page):
    page.value(
        "state.joints[0].shadow.tob = {torque_nm: 1.5, sigma_nm: 0.5, reference_nm: 1, rmse_nm: 2}; showState()"
    )
    row = page.value(
        "[...document.querySelectorAll('tbody tr')].find((row) => row.innerText.startsWith('tob')).innerText"
    )
    assert row.split() == ["tob", "+1.50", "0.50", "+0.50", "2.00"]
    page.until("cards[0].trace?.series.some((each) => each.label === 'tob')")
    assert page.value("new Set(Object.values(cards[0].columns).map((each) => each.length)).size") == 1
    assert page.errors == []


def test_keys_and_names_for_those_who_do_not_see_it(page):
    page.value("document.querySelector('tbody button').focus()")
    for kind in ("keyDown", "keyUp"):
        page.call(
            "Input.dispatchKeyEvent", type=kind, key=" ", code="Space", text=" " if kind == "keyDown" else ""
        )
    assert page.value("document.querySelector('tbody button').getAttribute('aria-pressed')") == "false"
    page.until("!cards[0].trace.series.at(-2).show")
    page.value("document.getElementById('pause').click()")
    stands = page.value("newest")
    time.sleep(0.2)
    assert page.value("newest") == stands
    nodes = [each for each in page.call("Accessibility.getFullAXTree")["nodes"] if not each["ignored"]]
    named = [(each["role"]["value"], each.get("name", {}).get("value", "")) for each in nodes]
    assert {("article", "Joint 1"), ("article", "Joint 2"), ("button", "Hold plots")} < {*named}
    assert "status" in {role for role, _ in named}
    assert any("+12.34 Nm" in name for role, name in named if role in ("image", "img"))
    assert all(name for role, name in named if role in ("button", "combobox", "image", "img"))


def test_silence_is_told_and_the_next_event_ends_it(page):
    page.value("source.close(); heardMs = -9999; showVerdict()")
    assert page.value("document.getElementById('verdict').innerText") == "✕No connection to jtqd"
    assert page.value("document.body.className") == "still"
    page.value("connect()")
    page.until(
        "document.getElementById('verdict').innerText === '✕Joint 2 stale' && !document.body.className"
    )
