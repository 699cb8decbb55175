"""Which frames belong to this cycle: the rule that keeps a stale input from being taken for a fresh one.

A TPDO carries no cycle number. It counts as an input of SYNC k only when it arrived after SYNC k and no earlier frame of
the same PDO can still be under way:

* frames arrive in order: one before the echo of the cycle's own SYNC belongs to an earlier cycle: late, dropped, counted;
  without that echo, or with the echo of an earlier SYNC (it waited in the transmit queue), nothing is used;
* after a cycle without its frame the PDO has a *debt* of one: the missing frame was lost, or it is late and will arrive in a
  later cycle, where it looks like that cycle's own. While there is a debt no frame of the PDO is used. A frame after the
  deadline, or a second one in a cycle, pays one frame of it. Else the missing frames count as lost in one of two cases:
  - the delays of the PDO have stayed within a narrow band, one frame came within it, and no other until the next SYNC;
  - the delays vary more, so the loop leaves a *gap*: slots without SYNC, in which only late frames can come, until one
    passes without any;
* a second frame with other bytes while there is no debt shows that a late frame was taken for a lost one. After such a
  frame, and after each gap, the PDO is in *quarantine*: it is used again after QUARANTINE cycles with one frame each. So a
  constant delay of more than one cycle never becomes valid, however irregular the arrivals are. This relies on the frames of
  one PDO keeping their order, as they do in a CAN controller;
* two frames in one cycle are harmless with equal bytes and a conflict with others (one is late, or there are two senders):
  then the input is not used in that cycle;
* a wrong length, a 29-bit identifier or a remote frame under one of our identifiers is rejected and counted;
* a SYNC that is not our own echo makes every input of the cycle doubtful: none is used;
* where another node sends SYNC (`begin_seen`), the SYNC seen takes the place of the echo, and only its own pauses are gaps;
* a frame with a COB-ID that only the loop may use, and that is no own echo, is a conflict: counted, and used for nothing;
* a node that sent its boot-up message has lost its PDO mapping: its PDOs are neither used nor waited for until it has been
  configured again. The same holds for one whose configuration was changed, and for an optional one that is absent.

A PDO that its producer sends by itself (transmission types 0, 254, 255) belongs to no cycle either. Its last frame is an input of
every cycle whose SYNC is at most `age_ns` away from it, by the kernel's stamps; nobody waits for it, and it has no debt. With a
step of CLOCK_REALTIME it is too old, until the next one comes.

A joint's temperature (TPDO3) is not bound to SYNC: it belongs to no cycle and nobody waits for it. Of the above only a wrong
format and a restart of its node concern it.

Pure: bytes and stamps in, values and counters out; no clock, no socket.
"""

cimport cython
from libc.math cimport NAN
from libc.stdint cimport int64_t, uint8_t, uint32_t, uint64_t
from libc.string cimport memcmp, memcpy, memset

from array import array
from typing import Final

from jtqd.daemon.shared.counters import COUNTERS, word_of
from jtqd.drivers.frame_socket cimport Frame
from jtqd.drivers import drive, nmt
from jtqd.drivers import frame as can_frame
from jtqd.drivers.pdo import SYNC_COB_ID

cdef int64_t LONGEST = 10  # slots of a gap; after that SYNC goes on and the debts stay
cdef int64_t PAUSE = 20  # cycles between two gaps: a bus that loses frames all the time must not lose its SYNC as well
cdef int64_t QUARANTINE = 5  # cycles with one frame each before a PDO is used again after a gap, or after a second frame with other bytes
cdef int64_t BAND_MARGIN_NS = 50_000  # around the learned delays: one frame of 135 bits may have been in the way less than twice
cdef int64_t NARROW_NS = 200_000  # a band wider than this cannot tell a late frame from one in time
cdef double BAND_LEAK = 1.0 / 1024.0  # the band shrinks towards the present delays with a time constant of about 1 s at 1 kHz
cdef int64_t NEVER = <int64_t> 1 << 62

cdef int STALE_INPUTS = word_of("stale_inputs"), LATE_FRAMES = word_of("late_frames")
cdef int DUPLICATE_FRAMES = word_of("duplicate_frames"), REJECTED_FRAMES = word_of("rejected_frames")
cdef int UNKNOWN_FRAMES = word_of("unknown_frames"), FOREIGN_SYNC = word_of("foreign_sync")
cdef int SYNC_ERRORS = word_of("sync_errors"), SYNC_GAPS = word_of("sync_gaps"), BOOT_UPS = word_of("boot_ups")
cdef int TEMPERATURES_LOST = word_of("temperatures_lost"), COB_ID_CONFLICTS = word_of("cob_id_conflicts")

cdef int8_t OWN = -2  # of `Intake.input_of`; -1: nobody's

cdef uint32_t SYNC = SYNC_COB_ID, HEARTBEAT = nmt.HEARTBEAT_BASE
cdef uint32_t IDENTIFIER = can_frame.CAN_EFF_MASK, NOT_STANDARD = can_frame.CAN_EFF_FLAG | can_frame.CAN_RTR_FLAG
cdef uint8_t BOOT_UP = nmt.BOOT_UP
cdef bint POSSIBLE[256]  # states of a heartbeat
cdef int _code
for _code in range(256):
    POSSIBLE[_code] = _code in nmt.STATES
if NOT_HEARD in nmt.STATES:
    raise ImportError("a heartbeat may have the state FFh, which stands for none")

cdef int TEMPERATURE_BYTES = 2
cdef int NOT_MEASURED = drive.NOT_MEASURED

_SIZES: Final = {"b": 1, "h": 2, "i": 4, "q": 8, "B": 1, "H": 2, "I": 4, "Q": 8}
"""Bytes of the objects that a PDO may carry, by their letters in `struct`; a small letter is a signed one."""


# One PDO --------------------------------------------------------------------------------------------------------------


cdef Input _input_of(pdo) except *:
    """Return the state of a PDO of which nothing has come; raises ValueError for a layout that cannot be decoded."""
    cdef Input state
    cdef int offset = 0
    letters = pdo.layout.format.lstrip("<")
    if len(letters) > MOST_FIELDS or not set(letters) <= set(_SIZES):
        raise ValueError(f"{pdo.name}: cannot decode the layout {pdo.layout.format!r}")
    memset(&state, 0, sizeof(Input))
    state.cob_id, state.length, state.node_id, state.age_ns = pdo.cob_id, pdo.length, pdo.node_id, pdo.age_ns
    for letter in letters:
        state.fields[state.field_count] = Field(offset, _SIZES[letter], letter.islower())
        state.field_count += 1
        offset += _SIZES[letter]
    state.wanted = 1
    state.band_low_ns = NEVER
    return state


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
    return delay_ns >= 0 and high - low <= NARROW_NS and low - BAND_MARGIN_NS <= delay_ns <= high + BAND_MARGIN_NS


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
#
# A value holds from the cycle that took its frame until the next one, or until it is `life_cycles` old, counted in slots and
# not by stamps: CLOCK_REALTIME may be stepped, and the frames and cycle numbers of a log alone tell what each cycle had.


cdef bint _receive(Temperature *temperature, const Frame *frame) noexcept nogil:
    """Decode a frame of TPDO3; return False for a wrong length, which is counted."""
    cdef Field field = Field(0, TEMPERATURE_BYTES, True)
    cdef int64_t raw
    if frame.length != TEMPERATURE_BYTES:
        temperature.rejected += 1
        return False
    raw = _number(frame.data, &field)
    temperature.celsius = NAN if raw == NOT_MEASURED else raw * temperature.c_per_unit
    temperature.arrived = True
    return True


cdef void _age(Temperature *temperature, int64_t cycle) noexcept nogil:
    """Discard a value that is too old at slot number `cycle`."""
    if temperature.arrived:
        temperature.arrived = False
        temperature.until = cycle + temperature.life_cycles
    elif cycle > temperature.until:
        temperature.until = NEVER
        temperature.celsius = NAN
        temperature.lost += 1


# All inputs -----------------------------------------------------------------------------------------------------------


cdef int _node(int node_id) except -1:
    """Return a node-ID that the tables have room for; raises ValueError for others."""
    if not 0 <= node_id < NODES:
        raise ValueError(f"{node_id} is no node-ID")
    return node_id


@cython.final
cdef class Intake:
    """Inputs of one cycle after the other.

    Per cycle: `begin()` when the SYNC has been sent, `take(...)` until it returns True or the deadline has passed, `close()`,
    then `fresh` and `values`; `drain(...)` for what arrives before the next SYNC. Where `gap_wanted` is then True,
    `pass_slot()` takes the place of the next cycle, and no SYNC is sent in its slot.

    pdos: expected (`InputPdo`), results are indexed in this order; temperatures: may come at any time (`TemperaturePdo`);
    own: COB-IDs that only the loop may use.

    Attributes:
        counters: words of the table of counters; conflict: COB-ID of the last conflict; a snapshot's once a loop has one.
        gap_wanted: the next slot shall pass without SYNC.
        claims: conflicts of COB-IDs are counted; not while the boot still sends the heartbeat.
        last_delay_ns: delay of the last input after the SYNC, in the last cycle that had them all.
        sync_stamp_ns: CLOCK_REALTIME stamp of the own SYNC's echo, 0 while it has not been seen in this cycle.

    Raises:
        ValueError: too many PDOs, two with one COB-ID, or a layout that cannot be decoded.
    """

    def __init__(self, pdos, temperatures=(), own=()):
        cdef int n, node
        self.pdos, self.temperatures = tuple(pdos), tuple(temperatures)
        self.count, self.temperature_count = len(self.pdos), len(self.temperatures)
        if max(self.count, self.temperature_count) > MOST_INPUTS:
            raise ValueError(f"found {self.count} inputs, expected at most {MOST_INPUTS}")
        identifiers = [each.cob_id for each in (*self.pdos, *self.temperatures)]
        if len({*identifiers}) != len(identifiers):
            raise ValueError("two inputs share a COB-ID")
        if identifiers and max(identifiers) >= IDENTIFIERS:
            raise ValueError(f"{max(identifiers):X}h has more than 11 bits")
        self.counters, self.conflict = array("Q", bytes(8 * len(COUNTERS))), array("Q", bytes(8))
        memset(self.input_of, -1, sizeof(self.input_of))
        memset(self.temperature_of, -1, sizeof(self.temperature_of))
        memset(self.nodes.state, NOT_HEARD, sizeof(self.nodes.state))
        for cob_id in own:
            self.input_of[<int> cob_id] = OWN
        for n, pdo in enumerate(self.pdos):
            self.inputs[n] = _input_of(pdo)
            self.input_of[<int> pdo.cob_id] = n
            self.is_producer[_node(pdo.node_id)] = True
            self.nodes.wanted += not pdo.age_ns
        for n, each in enumerate(self.temperatures):
            node = _node(each.node_id)
            self.celsius[n] = Temperature(each.cob_id, node, each.life_cycles, NEVER, False, NAN, each.c_per_unit, 0, 0)
            self.temperature_of[<int> each.cob_id] = n
            self.input_of[<int> each.cob_id] = -1

    # Python values ----------------------------------------------------------------------------------------------------

    def take(self, const uint8_t[::1] frames, stamps_ns, own, int count):
        """Sort in `count` frames of 16 bytes with their kernel stamps, `own` for echoes; True when all PDOs are there."""
        cdef Frame frame
        cdef int n
        for n in range(count):
            memcpy(&frame, &frames[16 * n], sizeof(Frame))
            self.take_frame(&frame, stamps_ns[n], own[n])
        return self.missing == 0

    def drain(self, const uint8_t[::1] frames, stamps_ns, own, int count):
        """Take frames received after the cycle was closed, late ones or duplicates, as `take`."""
        cdef Frame frame
        cdef int n
        for n in range(count):
            memcpy(&frame, &frames[16 * n], sizeof(Frame))
            self.drain_frame(&frame, stamps_ns[n], own[n])
        self.drained()

    def fresh(self, int index):
        """Return whether PDO `index` is an input of the cycle just closed."""
        return bool(self.inputs[index].fresh)

    def values(self, int index):
        """Return the raw integers of PDO `index`, in the order of its mapping; meaningful only when fresh."""
        cdef int n
        return tuple([self.inputs[index].values[n] for n in range(self.inputs[index].field_count)])

    def place(self, int index, values):
        """Put the raw integers of PDO `index` in place of a frame's, without its rules; None: it is no input (replay)."""
        cdef int n
        self.inputs[index].fresh = values is not None
        for n, value in enumerate(values or ()):
            self.inputs[index].values[n] = value

    def temperature(self, int index):
        """Return temperature `index` [degC]; NaN where it is not known."""
        return self.celsius[index].celsius

    def receive_temperature(self, int index, const uint8_t[::1] frame):
        """Decode a frame (`struct can_frame`) of temperature `index`; return False for a wrong length."""
        return bool(_receive(&self.celsius[index], <const Frame *> &frame[0]))

    @property
    def unconfigured(self):
        """Nodes that are not used until they have been configured: restarted, in doubt or absent."""
        return frozenset([node for node in range(NODES) if self.nodes.unconfigured[node]])

    def restarts(self, int node_id):
        """Return the number of boot-up messages of a node."""
        return self.nodes.restarts[_node(node_id)]

    def configured(self, int node_id):
        """Accept a configured node: its PDOs count from the next cycle on."""
        self.nodes.absent[_node(node_id)] = False
        self.believe(node_id, True)

    def leave_out(self, int node_id):
        """Leave out an optional node that is absent at the start; its PDOs are not counted as missing."""
        self.nodes.absent[_node(node_id)] = True
        self.believe(node_id, False)

    def doubt(self, int node_id):
        """Stop using a node whose configuration was changed."""
        self.believe(_node(node_id), False)

    # The cycle's own --------------------------------------------------------------------------------------------------

    cpdef void begin(self, int counter) noexcept:
        """Begin a cycle after SYNC number `counter` (1..240) was sent: no input is fresh."""
        cdef Gap *gap = &self.gap
        cdef Input *state
        cdef bint indebted = False
        cdef int n
        self.sync_counter = counter
        for n in range(self.count):
            state = &self.inputs[n]
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
        self.missing = self.nodes.wanted + indebted
        self.sync_stamp_ns = 0

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
            self.missing -= state.wanted

    cpdef bint close(self) noexcept:
        """Decide which inputs are used; True when every PDO of the nodes that are configured is a valid one."""
        cdef int64_t sync_ns = self.sync_stamp_ns, last_ns = 0, delay
        cdef bint complete = True
        cdef Input *state
        cdef int n
        for n in range(self.count):
            state = &self.inputs[n]
            if state.age_ns:
                state.fresh = self.is_young(state)
            elif state.fresh:
                delay = state.stamp_ns - sync_ns if sync_ns else -1
                if state.debt or state.quarantine or not state.wanted:
                    self.leave_unused(state, delay)
                elif delay >= 0:
                    _learn(state, delay)
                    last_ns = max(last_ns, delay)
                if state.conflict or not sync_ns or self.foreign_sync_now:
                    state.fresh = False
            elif state.wanted:
                state.debt += 1
                state.probation = False
            if state.fresh:
                state.in_a_row = 0
                continue
            state.missed += 1
            state.in_a_row += 1
            if state.wanted or not self.nodes.absent[state.node_id]:
                self.counters[STALE_INPUTS] += 1
                complete = False
        self.foreign_sync_now = False  # one that comes from here on belongs to the next cycle
        if complete and last_ns:
            self.last_delay_ns = last_ns
        return complete

    cdef bint is_young(self, const Input *state) noexcept nogil:
        """Return whether the last frame of a PDO that is sent by itself is an input of the cycle to be closed."""
        cdef int64_t sync_ns = self.sync_stamp_ns
        if not state.wanted or not state.has_data or not sync_ns or self.foreign_sync_now:
            return False
        return -state.age_ns <= sync_ns - state.stamp_ns <= state.age_ns

    cdef void leave_unused(self, Input *state, int64_t delay_ns) noexcept nogil:
        """A frame came, but it may be an earlier cycle's, or of a node that nobody has configured: it is not used."""
        state.fresh = False
        if not state.wanted:
            return
        if state.debt:
            state.probation = _usual(state, delay_ns)
            if not state.probation and not self.gap.pause:
                self.gap_wanted = True
        else:
            state.quarantine -= 1

    cdef void drain_frame(self, const Frame *frame, int64_t stamp_ns, bint own) noexcept nogil:
        """Take one frame that came after the cycle was closed."""
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
            self.gap.arrivals += 1
        else:
            self.duplicate(state, _differs(state, frame))

    cdef int without_own(self, Frame *frames, int64_t *stamps_ns, bint *own, int count) noexcept nogil:
        """Take out the frames with a COB-ID that only the loop may use; return how many remain. Echoes, and conflicts."""
        cdef int n, kept = 0
        for n in range(count):
            if frames[n].id < IDENTIFIERS and self.input_of[frames[n].id] == OWN:
                if self.claims and not own[n]:
                    self.conflict[0] = frames[n].id  # first: who sees the count rise reads it
                    self.counters[COB_ID_CONFLICTS] += 1
                continue
            if kept != n:
                frames[kept], stamps_ns[kept], own[kept] = frames[n], stamps_ns[n], own[n]
            kept += 1
        return kept

    cdef void drained(self) noexcept nogil:
        """All frames of a `drain` have been sorted in: one more slot without SYNC where late ones came in the last one."""
        cdef int n
        if self.gap.open and self.gap.arrivals > 0 and self.gap.length < LONGEST:
            self.gap_wanted = False
            for n in range(self.count):
                if self.inputs[n].debt:
                    self.gap_wanted = True

    cpdef void pass_slot(self) noexcept:
        """Pass a slot without SYNC: what comes in it is late, and what has not come by the end of a silent one was lost."""
        self.counters[SYNC_GAPS] += 1
        self.gap_wanted, self.gap.open = False, True
        self.gap.arrivals = 0
        self.gap.length += 1
        self.gap.pause = PAUSE

    cdef void idle(self, int node_id) noexcept nogil:
        """A node, or every one (0), was commanded to leave operational: it is in doubt until it has been started again."""
        cdef int n
        for n in range(NODES):
            if self.is_producer[n] and node_id in (0, n):
                self.believe(n, False)

    cdef void begin_seen(self, int counter, int64_t stamp_ns, bint regular, int64_t slots) noexcept:
        """Begin a cycle by the SYNC of another node, in place of an own one and its echo.

        regular: it comes as configured, else no input of the cycle is used; slots: since the last one. What was late has come
        in LONGEST of them.
        """
        if slots > LONGEST:
            self.gap.open, self.gap.arrivals = True, 0
        self.begin(counter)
        self.sync_stamp_ns = stamp_ns
        if not regular:
            self.foreign_sync_now = True
            self.counters[SYNC_ERRORS] += 1

    cdef Input *input_with(self, uint32_t can_id) noexcept nogil:
        """Return the PDO with this identifier, NULL for none."""
        cdef int n = self.input_of[can_id] if can_id < IDENTIFIERS else -1
        return NULL if n < 0 else &self.inputs[n]

    cdef Temperature *temperature_with(self, uint32_t can_id) noexcept nogil:
        """Return the temperature with this identifier, NULL for none."""
        cdef int n = self.temperature_of[can_id] if can_id < IDENTIFIERS else -1
        return NULL if n < 0 else &self.celsius[n]

    cdef void wrong_length(self, Input *state, int length) noexcept nogil:
        """Count a frame of `length` bytes, which differs from the mapping (CiA 301: 8210h shorter, 8220h longer)."""
        state.rejected += 1
        self.counters[REJECTED_FRAMES] += 1
        if length < state.length:
            state.too_short += 1
        else:
            state.too_long += 1

    cdef void late(self, Input *state) noexcept nogil:
        """A frame that was missing has come."""
        state.late += 1
        self.counters[LATE_FRAMES] += 1
        state.debt = max(0, state.debt - 1)

    cdef void duplicate(self, Input *state, bint differs) noexcept nogil:
        """A surplus frame: with other bytes an account was closed too early."""
        state.duplicates += 1
        self.counters[DUPLICATE_FRAMES] += 1
        if differs:
            state.quarantine = QUARANTINE

    cdef void own_sync(self, int counter, int64_t stamp_ns) noexcept nogil:
        """The echo of our SYNC: what came before it, in order of arrival, answers an earlier one."""
        cdef Input *state
        cdef int n
        # 0: a driver that echoes no more than was sent
        if counter != self.sync_counter and (counter or self.sync_stamp_ns):
            self.counters[SYNC_ERRORS] += 1
            return
        self.sync_stamp_ns = stamp_ns
        for n in range(self.count):
            state = &self.inputs[n]
            if state.fresh:
                state.fresh = False
                state.conflict = False
                self.missing += state.wanted
                self.late(state)

    cdef void second(self, Input *state, const Frame *frame, int64_t stamp_ns) noexcept nogil:
        """A second frame of one PDO in a cycle."""
        cdef bint differs = _differs(state, frame)
        if state.debt:
            self.late(state)
        else:
            self.duplicate(state, differs)
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
                self.counters[FOREIGN_SYNC] += 1
                self.foreign_sync_now = True
            return
        if self.is_heartbeat(can_id) and frame.length == 1:
            self.heartbeat(can_id - HEARTBEAT, frame.data[0], stamp_ns)
            return
        temperature = self.temperature_with(can_id)
        if temperature != NULL:
            if not self.nodes.unconfigured[temperature.node_id] and not _receive(temperature, frame):
                self.counters[REJECTED_FRAMES] += 1
            return
        state, temperature = self.input_with(identifier), self.temperature_with(identifier)
        if (state != NULL or temperature != NULL) and can_id & NOT_STANDARD:
            if state != NULL:
                state.rejected += 1
            else:
                temperature.rejected += 1
            self.counters[REJECTED_FRAMES] += 1
        elif identifier == SYNC or self.is_heartbeat(identifier):
            self.counters[REJECTED_FRAMES] += 1
        elif not own and can_id:  # 0: an NMT command, which a guest obeys
            self.counters[UNKNOWN_FRAMES] += 1

    # Temperatures -----------------------------------------------------------------------------------------------------

    cpdef void age_temperatures(self, int64_t cycle) noexcept nogil:
        """Discard temperatures that are too old at slot number `cycle`; between `close` and the estimates."""
        cdef int64_t lost
        cdef int n
        for n in range(self.temperature_count):
            lost = self.celsius[n].lost
            _age(&self.celsius[n], cycle)
            self.counters[TEMPERATURES_LOST] += self.celsius[n].lost - lost

    # Producers --------------------------------------------------------------------------------------------------------

    cdef bint is_heartbeat(self, uint32_t can_id) noexcept nogil:
        """Return whether the identifier is that of a producer's heartbeat."""
        return HEARTBEAT <= can_id < HEARTBEAT + NODES and self.is_producer[can_id - HEARTBEAT]

    cdef void heartbeat(self, int node_id, uint8_t state, int64_t stamp_ns) noexcept nogil:
        """Take a heartbeat; one with an impossible state is rejected."""
        if not POSSIBLE[state]:
            self.counters[REJECTED_FRAMES] += 1
            return
        self.nodes.state[node_id] = state
        self.nodes.heard_ns[node_id] = stamp_ns
        if state == BOOT_UP:  # the mapping is back to the device's default
            self.counters[BOOT_UPS] += 1
            self.nodes.restarts[node_id] += 1
            self.believe(node_id, False)

    cdef void believe(self, int node_id, bint configured) noexcept nogil:
        """Use a node's PDOs, or do not, from now on."""
        cdef Input *each
        cdef int n
        self.nodes.waiting += (not configured) - self.nodes.unconfigured[node_id]
        self.nodes.unconfigured[node_id] = not configured
        self.nodes.wanted = 0
        for n in range(self.count):
            each = &self.inputs[n]
            if each.node_id == node_id:
                each.wanted = configured
                each.debt = 0
                each.probation = False
                if each.age_ns:
                    each.has_data = False  # of a mapping that is no more
            if not each.age_ns:
                self.nodes.wanted += each.wanted
