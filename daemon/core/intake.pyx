"""Which frames belong to this cycle: the rule that keeps a stale input from being taken for a fresh one.

A TPDO carries no cycle number. It counts as an input of SYNC k only when it arrived after SYNC k and no earlier frame of
the same PDO can still be under way:

* frames arrive in order: one before the echo of the cycle's own SYNC belongs to an earlier cycle: late, dropped, counted;
  without that echo, or with the echo of an earlier SYNC (it waited in the transmit queue), nothing is used;
* after a cycle without its frame the PDO has a *debt*: the missing frame was lost, or it is late and will be met in a later
  cycle, looking just like that cycle's own. While there is a debt nothing is believed. It is paid by a surplus
  frame (two in one cycle), or written off in one of two ways:
  - the arrivals have been so regular that their delay tells: one frame came, in the usual band, and no other until the
    next SYNC: the missing one was lost;
  - otherwise the loop is asked for a *gap*: slots without SYNC, in which only late frames can come, until one passes
    without any. What has not come by then was lost.
* a surplus frame with other bytes, when no debt was left, shows that an account was closed too early; after that, and after
  each gap, a PDO is used again only when some cycles in a row have brought exactly one frame each.
  A constant delay of more than one cycle thus never becomes valid, however irregular the arrivals are. This relies on the
  frames of one PDO keeping their order, as they do in a CAN controller;
* two frames in one cycle are harmless with equal bytes and a conflict with others (one is late, or there are two senders):
  then the input is not used in that cycle;
* a wrong length, a 29-bit identifier or a remote frame under one of our identifiers is rejected and counted;
* a SYNC that is not our own echo makes every input of the cycle doubtful: none is used;
* the PDOs of a node that is not believed (`NodeTrust`) are not used.

A PDO that its producer sends by itself (transmission types 0, 254, 255) belongs to no cycle either. Its last frame is an input of
every cycle whose SYNC is at most `age_ns` away from it, by the kernel's stamps; nobody waits for it, and it has no debt. With a
step of CLOCK_REALTIME it is too old, until the next one comes.

A joint's temperature (TPDO3) is not bound to SYNC: it belongs to no cycle, nobody waits for it, and none of the above but
the last two rules concerns it.

Pure: bytes and stamps in, values and counters out; no clock, no socket. The methods on C values are what runs in a cycle; those
on Python values are for replays, for what is rare, and for tests.
"""

from libc.math cimport NAN
from libc.stdint cimport int64_t, uint8_t, uint32_t, uint64_t
from libc.string cimport memcmp, memcpy, memset

from typing import Final

from jtqd.drivers.frame_socket cimport Frame
from jtqd.drivers import drive, nmt
from jtqd.drivers import frame as can_frame
from jtqd.drivers.pdo import SYNC_COB_ID

_LONGEST: Final = 10
"""Slots; after that SYNC goes on and the debts stay."""
_PAUSE: Final = 20
"""Cycles between two gaps: a bus that loses frames all the time must not lose its SYNC as well."""
_QUARANTINE: Final = 5
"""Cycles with exactly one frame each before a PDO is used again whose account was closed without its frame."""
_BAND_MARGIN_NS: Final = 50_000
"""Allowance around the learned delays: one frame of 135 bits may have been in the way less than twice."""
_NARROW_NS: Final = 200_000
"""A band wider than this cannot tell a late frame from one in time."""
_BAND_LEAK: Final = 1.0 / 1024.0
"""The band shrinks towards what is seen now with a time constant of about a second at 1 kHz."""

cdef int64_t LONGEST = _LONGEST, PAUSE = _PAUSE, QUARANTINE = _QUARANTINE
cdef int64_t BAND_MARGIN_NS = _BAND_MARGIN_NS, NARROW_NS = _NARROW_NS
cdef double BAND_LEAK = _BAND_LEAK
cdef int64_t NEVER = <int64_t> 1 << 62

cdef uint32_t SYNC = SYNC_COB_ID, HEARTBEAT = nmt.HEARTBEAT_BASE
cdef uint32_t IDENTIFIER = can_frame.CAN_EFF_MASK, NOT_STANDARD = can_frame.CAN_EFF_FLAG | can_frame.CAN_RTR_FLAG
cdef uint8_t BOOT_UP = nmt.BOOT_UP
cdef enum:
    NOT_HEARD = 0xFF  # of `NodeState.state`
cdef bint POSSIBLE[256]  # what a heartbeat may say
cdef int _code
for _code in range(256):
    POSSIBLE[_code] = _code in nmt.STATES
if NOT_HEARD in nmt.STATES:
    raise ImportError("a heartbeat may say FFh, which stands for none")

cdef int TEMPERATURE_BYTES = 2
cdef int NOT_MEASURED = drive.NOT_MEASURED

_SIZES: Final = {"b": 1, "h": 2, "i": 4, "q": 8, "B": 1, "H": 2, "I": 4, "Q": 8}
"""Bytes of the objects that a PDO may carry, by their letters in `struct`; a small letter is a signed one."""


# One PDO --------------------------------------------------------------------------------------------------------------


cdef class InputState:
    """State of one synchronous PDO in the intake: frame of this cycle, missing frames, usual arrival.

    pdo: an `InputPdo` (`jtqd.daemon.core.input_pdos`): `cob_id`, `length`, `layout`, `node_id`, `name`, `age_ns`.
    """

    def __init__(self, pdo):
        cdef int offset = 0
        letters = pdo.layout.format.lstrip("<")
        if len(letters) > MOST_FIELDS or not set(letters) <= set(_SIZES):
            raise ValueError(f"{pdo.name}: cannot decode the layout {pdo.layout.format!r}")
        self.pdo = pdo
        self.input.cob_id, self.input.length, self.input.node_id = pdo.cob_id, pdo.length, pdo.node_id
        self.input.age_ns = pdo.age_ns
        for letter in letters:
            self.input.fields[self.input.field_count] = Field(offset, _SIZES[letter], letter.islower())
            self.input.field_count += 1
            offset += _SIZES[letter]
        self.input.wanted = 1
        self.input.band_low_ns = NEVER

    @property
    def unpack(self):
        """Raw integers of a frame's data, in the order of its mapping."""
        return self.pdo.layout.unpack_from

    @property
    def fresh(self):
        """Its frame is an input of the cycle just closed, or has come in this one."""
        return self.input.fresh

    @fresh.setter
    def fresh(self, bint fresh):
        self.input.fresh = fresh

    @property
    def values(self):
        """Raw integers in the order of its mapping; meaningful only when fresh."""
        return tuple([self.input.values[n] for n in range(self.input.field_count)])

    @values.setter
    def values(self, values):
        cdef int n
        for n in range(self.input.field_count):
            self.input.values[n] = values[n]

    @property
    def stamp_ns(self):
        """Kernel stamp of its last frame, CLOCK_REALTIME."""
        return self.input.stamp_ns

    @stamp_ns.setter
    def stamp_ns(self, int64_t stamp_ns):
        self.input.stamp_ns = stamp_ns

    @property
    def debt(self):
        """Frames that are missing and may still come."""
        return self.input.debt

    @debt.setter
    def debt(self, int64_t debt):
        self.input.debt = debt

    @property
    def quarantine(self):
        """Regular cycles until it is used again."""
        return self.input.quarantine

    @quarantine.setter
    def quarantine(self, int64_t quarantine):
        self.input.quarantine = quarantine

    @property
    def wanted(self):
        """0 while its node is absent or not configured: nobody waits for it then."""
        return self.input.wanted

    @property
    def band_low_ns(self):
        """Usual arrival after SYNC, from here on."""
        return self.input.band_low_ns

    @property
    def band_high_ns(self):
        """Usual arrival after SYNC, up to here."""
        return self.input.band_high_ns

    @property
    def late(self):
        """Frames that came after their cycle."""
        return self.input.late

    @property
    def lost(self):
        """Frames that never came."""
        return self.input.lost

    @property
    def duplicates(self):
        """Frames that came twice."""
        return self.input.duplicates

    @property
    def rejected(self):
        """Frames of another length, 29-bit or remote frames."""
        return self.input.rejected

    @property
    def missed(self):
        """Cycles without a valid one."""
        return self.input.missed

    @property
    def in_a_row(self):
        """Those until now since the last valid one."""
        return self.input.in_a_row

    @property
    def short(self):
        """Frames shorter than the mapping (CiA 301: 8210h)."""
        return self.input.too_short

    @property
    def long(self):
        """Frames longer than the mapping (CiA 301: 8220h)."""
        return self.input.too_long


cdef int64_t _number(const uint8_t *data, const Field *field) noexcept nogil:
    """Return one object of a PDO, little endian."""
    cdef uint64_t raw = 0
    cdef int unused = 64 - 8 * field.size
    memcpy(&raw, data + field.offset, field.size)
    if field.is_signed:
        return <int64_t> (raw << unused) >> unused
    return <int64_t> raw


cdef void _keep(Input *state, const Frame *frame, int64_t stamp_ns) noexcept nogil:
    """This frame is the PDO's last one."""
    cdef int n
    for n in range(state.field_count):
        state.values[n] = _number(frame.data, &state.fields[n])
    memcpy(state.data, frame.data, sizeof(state.data))
    state.has_data = True
    state.stamp_ns = stamp_ns


cdef bint _differs(const Input *state, const Frame *frame) noexcept nogil:
    """The frame holds other bytes than the PDO's last one."""
    return not state.has_data or memcmp(state.data, frame.data, sizeof(state.data)) != 0


cdef bint _usual(const Input *state, int64_t delay_ns) noexcept nogil:
    """Return whether the delay of a frame shows that it is this cycle's own, while an earlier one is missing."""
    cdef int64_t low = state.band_low_ns, high = state.band_high_ns
    return (
        delay_ns >= 0
        and high - low <= NARROW_NS
        and low - BAND_MARGIN_NS <= delay_ns <= high + BAND_MARGIN_NS
    )


cdef void _learn(Input *state, int64_t delay_ns) noexcept nogil:
    """Learn the arrival band: widen at once, narrow slowly."""
    if delay_ns < state.band_low_ns:
        state.band_low_ns = delay_ns
    else:
        state.band_low_ns += <int64_t> (<double> (delay_ns - state.band_low_ns) * BAND_LEAK)
    if delay_ns > state.band_high_ns:
        state.band_high_ns = delay_ns
    else:
        state.band_high_ns -= <int64_t> (<double> (state.band_high_ns - delay_ns) * BAND_LEAK)


# A joint's temperature ------------------------------------------------------------------------------------------------


cdef class JointTemperature:
    """Temperature of a joint: what its drive sent last by TPDO3, for as long as that is worth something.

    TPDO3 comes by an event timer, not with SYNC, so it belongs to no cycle: a value holds from the cycle that took its
    frame until the next one, or until it is TEMPERATURE_LIFE_S old. Its age is counted in slots and not by stamps, because
    CLOCK_REALTIME may be stepped, and so that the frames and cycle numbers of a log alone say what each cycle had.

    Args:
        cob_id: of TPDO3.
        node_id: of its drive.
        name: as it appears in counters and lines, e.g. "381h drive 1 TPDO3".
        life_cycles: slots after which a value is forgotten.
        c_per_unit: degrees Celsius per unit of its object.

    Attributes:
        celsius: what the cycle may use; NaN where it is not known.
        lost: how often a value was forgotten because no other came.
        rejected: frames with this identifier and a wrong length, or 29-bit or remote frames.
    """

    def __init__(
        self, uint32_t cob_id, int node_id, name, int64_t life_cycles, double c_per_unit=drive.TEMPERATURE_C_PER_UNIT
    ):
        self.name = name
        self.known.c_per_unit = c_per_unit
        self.known.cob_id, self.known.node_id, self.known.life_cycles = cob_id, node_id, life_cycles
        self.known.until = NEVER
        self.known.celsius = NAN

    @property
    def cob_id(self):
        return self.known.cob_id

    @property
    def node_id(self):
        return self.known.node_id

    @property
    def celsius(self):
        return self.known.celsius

    @celsius.setter
    def celsius(self, double celsius):
        self.known.celsius = celsius

    @property
    def lost(self):
        return self.known.lost

    @property
    def rejected(self):
        return self.known.rejected

    def receive(self, const uint8_t[::1] frames, int offset):
        """Decode the frame (`struct can_frame`) at `offset`; return False for a wrong length."""
        cdef Frame frame
        memcpy(&frame, &frames[offset], sizeof(Frame))
        return _receive_temperature(&self.known, &frame)

    def at(self, int64_t cycle):
        """Discard a value that is too old at slot number `cycle`."""
        temperature_at(&self.known, cycle)


cdef bint _receive_temperature(Temperature *known, const Frame *frame) noexcept nogil:
    """As `JointTemperature.receive`."""
    cdef Field field = Field(0, TEMPERATURE_BYTES, True)
    cdef int64_t raw
    if frame.length != TEMPERATURE_BYTES:
        known.rejected += 1
        return False
    raw = _number(frame.data, &field)
    known.celsius = NAN if raw == NOT_MEASURED else raw * known.c_per_unit
    known.news = True
    return True


cdef void temperature_at(Temperature *known, int64_t cycle) noexcept nogil:
    """As `JointTemperature.at`."""
    if known.news:
        known.news = False
        known.until = cycle + known.life_cycles
    elif cycle > known.until:
        known.until = NEVER
        known.celsius = NAN
        known.lost += 1


UNKNOWN: Final = JointTemperature(0, 0, "none", 0)
"""Of a joint whose drive sends none."""


# Slots without SYNC ---------------------------------------------------------------------------------------------------


cdef class Gaps:
    """Slots without SYNC: what comes in one is late, and what has not come by the end of a silent one was lost.

    `Intake` asks for a gap where the delay of a frame does not tell whether it is a late one.

    Attributes:
        count: slots without SYNC so far.
        wanted: the next slot shall pass without SYNC.
        open: the last slot did.
        arrivals: late frames in the last slot.
        pause: cycles before the next gap.
        length: slots of the present gap.
    """

    @property
    def count(self):
        return self.now.count

    @property
    def wanted(self):
        return self.now.wanted

    @wanted.setter
    def wanted(self, bint wanted):
        self.now.wanted = wanted

    @property
    def open(self):
        return self.now.open

    @property
    def arrivals(self):
        return self.now.arrivals

    @property
    def pause(self):
        return self.now.pause

    @property
    def length(self):
        return self.now.length

    def pass_slot(self):
        """Pass a slot without SYNC."""
        self.now.count += 1
        self.now.wanted, self.now.open = False, True
        self.now.arrivals = 0
        self.now.length += 1
        self.now.pause = PAUSE


cdef bint _may_go_on(const GapState *gap) noexcept nogil:
    """Return whether one more slot may pass, as late frames came in the last one."""
    return gap.open and gap.arrivals > 0 and gap.length < LONGEST


# Producers ------------------------------------------------------------------------------------------------------------


cdef class NodeTrust:
    """Which producers of the input PDOs may be believed: heartbeats, who has restarted, who has been configured since.

    A node that sent its boot-up message has lost its PDO mapping. None of its PDOs is used or waited for until `configured`.
    The same holds for one that was found to be configured otherwise (`doubt`), and for an optional one that is absent.

    Args:
        pdos: states of all input PDOs; `wanted` of each is kept here.

    Attributes:
        heartbeats: node-ID by COB-ID of its heartbeat.
        wanted: number of PDOs whose node is believed.
        unconfigured: nodes that are not, because they restarted, are in doubt or absent.
        absent: those of them that are missed by nobody.
        states: last heartbeat state of each node (`drivers.nmt.STATES`).
        heard_ns: kernel stamp of that heartbeat, CLOCK_REALTIME.
        boot_ups: boot-up messages of all nodes.
        restarts: boot-up messages of each node that has sent one.
    """

    def __init__(self, pdos):
        cdef InputState state
        self.states_of = tuple(pdos)
        self.heartbeats = {}
        memset(self.now.state, NOT_HEARD, sizeof(self.now.state))
        for state in self.states_of:
            node_id = state.pdo.node_id
            self.heartbeats[nmt.HEARTBEAT_BASE + node_id] = node_id
            self.producer[_node(node_id)] = True
            self.inputs[self.count] = &state.input
            self.count += 1
            self.now.wanted += not state.input.age_ns

    @property
    def wanted(self):
        return self.now.wanted

    @property
    def unconfigured(self):
        return frozenset([node for node in range(NODES) if self.now.unconfigured[node]])

    @property
    def absent(self):
        return frozenset([node for node in range(NODES) if self.now.absent[node]])

    @property
    def states(self):
        return {node: self.now.state[node] for node in range(NODES) if self.now.state[node] != NOT_HEARD}

    @property
    def heard_ns(self):
        return {node: self.now.heard_ns[node] for node in range(NODES) if self.now.state[node] != NOT_HEARD}

    @property
    def boot_ups(self):
        return self.now.boot_ups

    @property
    def restarts(self):
        return {node: self.now.restarts[node] for node in range(NODES) if self.now.restarts[node]}

    def heartbeat(self, int node_id, uint8_t state, int64_t stamp_ns):
        """Take a heartbeat of one byte; return False for an impossible state."""
        return self.heard(_node(node_id), state, stamp_ns)

    def configured(self, int node_id):
        """Accept a configured node: its PDOs count from the next cycle on."""
        self.now.absent[_node(node_id)] = False
        self.believe(node_id, True)

    def leave_out(self, int node_id):
        """Leave out an optional node that is absent at the start; its PDOs are not counted as missing."""
        self.now.absent[_node(node_id)] = True
        self.believe(node_id, False)

    def doubt(self, int node_id):
        """Stop using this node."""
        self.believe(_node(node_id), False)

    cdef bint heard(self, int node_id, uint8_t state, int64_t stamp_ns) noexcept nogil:
        """As `heartbeat`."""
        if not POSSIBLE[state]:
            return False
        self.now.state[node_id] = state
        self.now.heard_ns[node_id] = stamp_ns
        if state == BOOT_UP:  # the mapping is back to the device's default
            self.now.boot_ups += 1
            self.now.restarts[node_id] += 1
            self.believe(node_id, False)
        return True

    cdef void believe(self, int node_id, bint configured) noexcept nogil:
        """Its PDOs are used, or are not, from now on."""
        cdef Input *each
        cdef int n
        self.now.waiting += (not configured) - self.now.unconfigured[node_id]
        self.now.unconfigured[node_id] = not configured
        self.now.wanted = 0
        for n in range(self.count):
            each = self.inputs[n]
            if each.node_id == node_id:
                each.wanted = configured
                each.debt = 0
                each.probation = False
                if each.age_ns:
                    each.has_data = False  # of a mapping that is no more
            if not each.age_ns:
                self.now.wanted += each.wanted


cdef int _node(int node_id) except -1:
    """Return a node-ID that the tables have room for; raises ValueError for others."""
    if not 0 <= node_id < NODES:
        raise ValueError(f"{node_id} is no node-ID")
    return node_id


# All of them ----------------------------------------------------------------------------------------------------------


cdef class Intake:
    """Inputs of one cycle after the other.

    Use per cycle: `begin()` when the SYNC has been sent, `take(...)` for each batch of frames until it returns True or the
    deadline has passed, `close()`, then read `values` and `fresh`; `drain(...)` for what arrives before the next SYNC. Where
    `gaps.wanted` is then True, `gaps.pass_slot()` takes the place of the next cycle, and no SYNC is sent in its slot.

    Args:
        pdos: the expected PDOs; results are indexed in this order.
        temperatures: joint temperatures that may come at any time.

    Attributes:
        nodes: which of their producers may be believed.
        gaps: slots without SYNC.
        last_delay_ns: delay of the last input after the SYNC, in the last cycle that had them all.
        sync_stamp_ns: CLOCK_REALTIME stamp of the own SYNC's echo, 0 while it has not been seen in this cycle.
        sync_errors: echoes of an earlier SYNC than the one of the cycle: the transmit queue holds it back.
    """

    def __init__(self, pdos, temperatures=()):
        cdef InputState state
        cdef JointTemperature temperature
        self.pdos, self.temperatures = tuple(pdos), tuple(temperatures)
        if max(len(self.pdos), len(self.temperatures)) > MOST_INPUTS:
            raise ValueError(f"found {len(self.pdos)} inputs, expected at most {MOST_INPUTS}")
        identifiers = [each.cob_id for each in (*self.pdos, *self.temperatures)]
        if len({*identifiers}) != len(identifiers):
            raise ValueError("two inputs share a COB-ID")
        if identifiers and max(identifiers) >= IDENTIFIERS:
            raise ValueError(f"{max(identifiers):X}h has more than 11 bits")
        memset(self.input_of, -1, sizeof(self.input_of))
        memset(self.temperature_of, -1, sizeof(self.temperature_of))
        self.states = [InputState(pdo) for pdo in self.pdos]
        for state in self.states:
            self.inputs[self.count] = &state.input
            self.input_of[state.input.cob_id] = self.count
            self.count += 1
        for temperature in self.temperatures:
            _node(temperature.known.node_id)
            self.celsius[self.temperature_count] = &temperature.known
            self.temperature_of[temperature.known.cob_id] = self.temperature_count
            self.temperature_count += 1
        self.nodes, self.gaps = NodeTrust(self.states), Gaps()

    @property
    def last_delay_ns(self):
        return self.now.last_delay_ns

    @property
    def sync_stamp_ns(self):
        return self.now.sync_stamp_ns

    @sync_stamp_ns.setter
    def sync_stamp_ns(self, int64_t stamp_ns):
        self.now.sync_stamp_ns = stamp_ns

    @property
    def foreign_sync(self):
        return self.now.foreign_sync

    @property
    def sync_errors(self):
        return self.now.sync_errors

    @property
    def unknown_frames(self):
        return self.now.unknown_frames

    @property
    def late_frames(self):
        return self.now.late_frames

    @property
    def duplicate_frames(self):
        return self.now.duplicate_frames

    @property
    def rejected_frames(self):
        return self.now.rejected_frames

    @property
    def stale_inputs(self):
        return self.now.stale_inputs

    # Python values ----------------------------------------------------------------------------------------------------

    def begin(self, int counter):
        """Begin a cycle after SYNC number `counter` (1..240) was sent: no input is fresh."""
        self.begin_cycle(counter)

    def take(self, const uint8_t[::1] frames, stamps_ns, own, int count):
        """Sort `count` frames in.

        Args:
            frames: `count` times 16 bytes of `struct can_frame`.
            stamps_ns: kernel receive stamps, CLOCK_REALTIME.
            own: True for echoes of our own frames.
            count: number of frames.

        Returns:
            True when every expected PDO of this cycle is there.
        """
        cdef Frame frame
        cdef int n
        for n in range(count):
            memcpy(&frame, &frames[16 * n], sizeof(Frame))
            self.take_frame(&frame, stamps_ns[n], own[n])
        return self.now.missing == 0

    def close(self):
        """Close the cycle at the deadline, or when all inputs are received: decide which are used.

        Returns:
            True when every PDO of the nodes that are configured is a valid input of this cycle.
        """
        return self.close_cycle()

    def drain(self, const uint8_t[::1] frames, stamps_ns, own, int count):
        """Take frames received after the cycle was closed: late, or duplicates."""
        cdef Frame frame
        cdef int n
        for n in range(count):
            memcpy(&frame, &frames[16 * n], sizeof(Frame))
            self.drain_frame(&frame, stamps_ns[n], own[n])
        self.drained()

    def configured(self, node_id):
        """See `NodeTrust.configured`."""
        self.nodes.configured(node_id)

    def absent(self, node_id):
        """See `NodeTrust.leave_out`."""
        self.nodes.leave_out(node_id)

    @property
    def unconfigured(self):
        """Return the nodes that are not used until they have been configured."""
        return self.nodes.unconfigured

    def fresh(self, index):
        """Return whether PDO `index` is an input of the cycle just closed."""
        return self.states[index].fresh

    def values(self, index):
        """Return the raw integers of PDO `index`, in the order of its mapping; meaningful only when fresh."""
        return self.states[index].values

    def views(self):
        """The states themselves: `.fresh` and `.values`."""
        return self.states

    # The cycle's own --------------------------------------------------------------------------------------------------

    cdef void begin_cycle(self, int counter) noexcept nogil:
        """As `begin`."""
        cdef GapState *gap = &self.gaps.now
        cdef Input *state
        cdef bint indebted = False
        cdef int n
        self.now.counter = counter
        for n in range(self.count):
            state = self.inputs[n]
            state.fresh = False
            state.conflict = False
            if state.debt and state.wanted:
                if state.probation or (gap.open and not gap.arrivals):
                    state.lost += state.debt
                    state.debt = 0
                    state.probation = False
                    if gap.open:
                        state.quarantine = QUARANTINE
                else:
                    indebted = True
        gap.open = False
        gap.length = 0
        if gap.pause:
            gap.pause -= 1
        # With a debt one more frame may come: then only the deadline ends the wait.
        self.now.missing = self.nodes.now.wanted + indebted
        self.now.sync_stamp_ns = 0

    cdef void take_frame(self, const Frame *frame, int64_t stamp_ns, bint own) noexcept nogil:
        """Sort one frame in."""
        cdef Input *state = self.input_with(frame.id)
        if state == NULL:
            self.other(frame, stamp_ns, own)
        elif frame.length != state.length:
            self.wrong_length(state, frame.length)
        elif state.age_ns:
            _keep(state, frame, stamp_ns)
        elif state.fresh:
            self.second(state, frame, stamp_ns)
        else:
            state.fresh = True
            _keep(state, frame, stamp_ns)
            self.now.missing -= state.wanted

    cdef bint close_cycle(self) noexcept nogil:
        """As `close`."""
        cdef int64_t sync_ns = self.now.sync_stamp_ns, last_ns = 0, delay
        cdef bint complete = True
        cdef Input *state
        cdef int n
        for n in range(self.count):
            state = self.inputs[n]
            if state.age_ns:
                state.fresh = self.young(state)
            elif state.fresh:
                delay = state.stamp_ns - sync_ns if sync_ns else -1
                if state.debt or state.quarantine or not state.wanted:
                    self.doubt(state, delay)
                elif delay >= 0:
                    _learn(state, delay)
                    last_ns = max(last_ns, delay)
                if state.conflict or not sync_ns or self.now.foreign_sync_now:
                    state.fresh = False
            elif state.wanted:
                state.debt += 1
                state.probation = False
            if state.fresh:
                state.in_a_row = 0
                continue
            state.missed += 1
            state.in_a_row += 1
            if state.wanted or not self.nodes.now.absent[state.node_id]:
                self.now.stale_inputs += 1
                complete = False
        self.now.foreign_sync_now = False  # one that comes from here on belongs to the next cycle
        if complete and last_ns:
            self.now.last_delay_ns = last_ns
        return complete

    cdef bint young(self, const Input *state) noexcept nogil:
        """Return whether the last frame of a PDO that is sent by itself is an input of the cycle to be closed."""
        cdef int64_t sync_ns = self.now.sync_stamp_ns
        if not state.wanted or not state.has_data or not sync_ns or self.now.foreign_sync_now:
            return False
        return -state.age_ns <= sync_ns - state.stamp_ns <= state.age_ns

    cdef void doubt(self, Input *state, int64_t delay_ns) noexcept nogil:
        """A frame came, but it may be an earlier cycle's, or of a node that nobody has configured: it is not used."""
        state.fresh = False
        if not state.wanted:
            return
        if state.debt:
            state.probation = _usual(state, delay_ns)
            if not state.probation and not self.gaps.now.pause:
                self.gaps.now.wanted = True
        else:
            state.quarantine -= 1

    cdef void drain_frame(self, const Frame *frame, int64_t stamp_ns, bint own) noexcept nogil:
        """One frame that came after the cycle was closed."""
        cdef Input *state = self.input_with(frame.id)
        if state == NULL:
            self.other(frame, stamp_ns, own)
        elif frame.length != state.length:
            self.wrong_length(state, frame.length)
        elif state.age_ns:
            _keep(state, frame, stamp_ns)
        elif not state.wanted:
            return  # of a node with a mapping that nobody has checked
        elif state.debt:
            self.late(state)
            state.probation = False
            self.gaps.now.arrivals += 1
        else:
            state.duplicates += 1
            self.now.duplicate_frames += 1
            if _differs(state, frame):
                state.quarantine = QUARANTINE

    cdef void drained(self) noexcept nogil:
        """All frames of a `drain` have been sorted in."""
        cdef int n
        if _may_go_on(&self.gaps.now):
            self.gaps.now.wanted = False
            for n in range(self.count):
                if self.inputs[n].debt:
                    self.gaps.now.wanted = True

    cdef Input *input_with(self, uint32_t can_id) noexcept nogil:
        """Return the PDO with this identifier, NULL for none."""
        cdef int n = self.input_of[can_id] if can_id < IDENTIFIERS else -1
        return NULL if n < 0 else self.inputs[n]

    cdef Temperature *temperature_with(self, uint32_t can_id) noexcept nogil:
        """Return the temperature with this identifier, NULL for none."""
        cdef int n = self.temperature_of[can_id] if can_id < IDENTIFIERS else -1
        return NULL if n < 0 else self.celsius[n]

    cdef void wrong_length(self, Input *state, int length) noexcept nogil:
        """Count a frame of `length` bytes, which differs from the mapping (CiA 301: 8210h shorter, 8220h longer)."""
        state.rejected += 1
        self.now.rejected_frames += 1
        if length < state.length:
            state.too_short += 1
        else:
            state.too_long += 1

    cdef void late(self, Input *state) noexcept nogil:
        """A frame that was missing has come."""
        state.late += 1
        self.now.late_frames += 1
        state.debt = max(0, state.debt - 1)

    cdef void own_sync(self, int counter, int64_t stamp_ns) noexcept nogil:
        """The echo of our SYNC: what came before it, in order of arrival, answers an earlier one."""
        cdef Input *state
        cdef int n
        if counter != self.now.counter and (counter or self.now.sync_stamp_ns):  # 0: a driver that echoes no more than was sent
            self.now.sync_errors += 1
            return
        self.now.sync_stamp_ns = stamp_ns
        for n in range(self.count):
            state = self.inputs[n]
            if state.fresh:
                state.fresh = False
                state.conflict = False
                self.now.missing += state.wanted
                self.late(state)

    cdef void second(self, Input *state, const Frame *frame, int64_t stamp_ns) noexcept nogil:
        """A second frame of one PDO in a cycle."""
        cdef bint differs = _differs(state, frame)
        if state.debt:
            self.late(state)
        else:
            state.duplicates += 1
            self.now.duplicate_frames += 1
            if differs:
                state.quarantine = QUARANTINE
        if differs:
            state.conflict = True
        _keep(state, frame, stamp_ns)

    cdef void other(self, const Frame *frame, int64_t stamp_ns, bint own) noexcept nogil:
        """A frame that is none of the PDOs: SYNC, a heartbeat, a temperature, or one that should not be there."""
        cdef uint32_t can_id = frame.id, identifier = can_id & IDENTIFIER
        cdef Temperature *temperature
        cdef Input *state
        if can_id == SYNC:
            if own:
                self.own_sync(frame.data[0], stamp_ns)
            else:
                self.now.foreign_sync += 1
                self.now.foreign_sync_now = True
            return
        if self.is_heartbeat(can_id) and frame.length == 1:
            if not self.nodes.heard(can_id - HEARTBEAT, frame.data[0], stamp_ns):
                self.now.rejected_frames += 1
            return
        temperature = self.temperature_with(can_id)
        if temperature != NULL:
            if not self.nodes.now.unconfigured[temperature.node_id] and not _receive_temperature(temperature, frame):
                self.now.rejected_frames += 1
            return
        state, temperature = self.input_with(identifier), self.temperature_with(identifier)
        if (state != NULL or temperature != NULL) and can_id & NOT_STANDARD:
            if state != NULL:
                state.rejected += 1
            else:
                temperature.rejected += 1
            self.now.rejected_frames += 1
        elif identifier == SYNC or self.is_heartbeat(identifier):
            self.now.rejected_frames += 1
        elif not own:
            self.now.unknown_frames += 1

    cdef bint is_heartbeat(self, uint32_t can_id) noexcept nogil:
        """The identifier is that of a producer's heartbeat."""
        return HEARTBEAT <= can_id < HEARTBEAT + NODES and self.nodes.producer[can_id - HEARTBEAT]
