"""Cycles of a log through the joints of the loop, without a bus: inputs of many cycles at once, for replay."""

from cpython.object cimport PyObject
from libc.math cimport isnan
from libc.stdint cimport int64_t, uint8_t
from libc.string cimport memcpy

import numpy as np

from jtqd.daemon.core.cycle import STARTING_CYCLES
from jtqd.daemon.core.joint cimport ContactWatch
from jtqd.daemon.core.estimate_pdo cimport NOBODY, Published, encode_into, field_of
from jtqd.daemon.core.intake cimport MOST_FIELDS, Intake, Temperature
from jtqd.daemon.core.joint cimport JointCycle, JointState
from jtqd.daemon.core.record cimport MOST_JOINTS, JointBlock, ShadowBlock
from jtqd.daemon.shared import cycle_record as cr
from jtqd.estimator import status as st

cdef int64_t FIRST_CYCLES = STARTING_CYCLES
cdef int STALE = st.STALE, WITHDRAWN = cr.FLAG_WITHDRAWN, UNCHECKED = cr.FLAG_UNCHECKED, STARTING = cr.FLAG_STARTING


def fields(torque_nm, sigma_nm, status):
    """Return the integers (torque, sigma, status) of an estimate PDO's field, arrays [n], as the loop makes them."""
    cdef const double[::1] torque = np.ascontiguousarray(torque_nm, np.float64)
    cdef const double[::1] sigma = np.ascontiguousarray(sigma_nm, np.float64)
    cdef const int[::1] code = np.ascontiguousarray(status, np.intc)
    out = np.empty((3, torque.shape[0]), np.intc)
    cdef int[:, ::1] to = out
    cdef Published made
    cdef Py_ssize_t k
    for k in range(torque.shape[0]):
        made = field_of(torque[k], sigma[k], code[k])
        to[0, k], to[1, k], to[2, k] = made.torque, made.sigma, made.status
    return out[0], out[1], out[2]


cdef class CycleRows:
    """Rows of a log: inputs in, records and estimate PDOs out.

    Args:
        intake, joints: the loop's; the intake decides nothing here, it holds the inputs.
        fresh: of each input, whether it counted [inputs, n].
        values: of each input, its integers in the order of its mapping; one array [objects, n] per input.
        celsius: of each joint temperature, as logged [temperatures, n]; NaN where not known.
        cycle, counter: number of the cycle, and its SYNC counter [n].
        sync_ns: of each joint, when its SYNC went out [joints, n].
        wanted: of each joint, whether there was time for the network [joints, n].
        flags: of each joint, its `cycle_flags`, as logged [joints, n].
        contacts: the loop's, None where they are not watched.
        velocity: of each joint, the motor velocity as logged [joints, n], for drives without one; None: derived again.

    Attributes:
        samples: of each joint, blocks of the cycle record [joints, n, bytes], with that of its shadow methods behind.
        estimates: estimate PDOs one after the other [n, 8 * PDOs].
        temperatures_from_log: how often the frames gave another temperature than the log.

    Raises:
        ValueError: arrays that do not fit together.
    """

    cdef Intake intake
    cdef tuple joints
    cdef int count, pdos
    cdef JointState *states[MOST_JOINTS]
    cdef const uint8_t[:, ::1] fresh, wanted, flags
    cdef const int64_t[:, :, ::1] values
    cdef const double[:, ::1] celsius
    cdef const int64_t[::1] cycle, counter
    cdef const int64_t[:, ::1] sync_ns
    cdef const double[:, ::1] velocity
    cdef bint with_velocity
    cdef ContactWatch contacts
    cdef bint watches
    cdef uint8_t[:, :, ::1] to_samples
    cdef uint8_t[:, ::1] to_estimates
    cdef readonly object samples, estimates
    cdef readonly int64_t temperatures_from_log

    def __init__(
        self, Intake intake, joints, *, fresh, values, celsius, cycle, counter, sync_ns, wanted, flags, velocity=None,
        ContactWatch contacts=None
    ):
        cdef JointCycle joint
        n = len(cycle)
        laid = np.zeros((intake.count, MOST_FIELDS, n), np.int64)
        for index, columns in enumerate(values):
            laid[index, : len(columns)] = columns
        self.intake, self.joints, self.count = intake, tuple(joints), len(joints)
        self.pdos = (self.count + 1) // 2
        self.contacts, self.watches = contacts, contacts is not None
        for index in range(self.count):
            joint = self.joints[index]
            self.states[index] = &joint.now
        self.fresh = _checked(fresh, np.uint8, (intake.count, n))
        self.values = laid
        self.celsius = _checked(celsius, np.float64, (intake.temperature_count, n))
        self.cycle, self.counter = _checked(cycle, np.int64, (n,)), _checked(counter, np.int64, (n,))
        self.sync_ns = _checked(sync_ns, np.int64, (self.count, n))
        self.wanted, self.flags = _checked(wanted, np.uint8, (self.count, n)), _checked(flags, np.uint8, (self.count, n))
        self.with_velocity = velocity is not None
        self.velocity = _checked(np.zeros((self.count, n)) if velocity is None else velocity, np.float64, (self.count, n))
        size = sizeof(JointBlock) + (sizeof(ShadowBlock) if self.states[0].shadow != NULL else 0)
        self.samples = np.zeros((self.count, n, size), np.uint8)
        self.estimates = np.zeros((n, 8 * self.pdos), np.uint8)
        self.to_samples, self.to_estimates = self.samples, self.estimates

    def go_on(self, Py_ssize_t first, Py_ssize_t end):
        """Estimate rows first to end - 1; rows come in order."""
        cdef Py_ssize_t row
        cdef const Published *second
        cdef JointCycle joint
        cdef PyObject *at[MOST_JOINTS]
        cdef int n
        for n in range(self.count):
            joint = self.joints[n]
            at[n] = <PyObject *> joint
        if not 0 <= first <= end <= self.cycle.shape[0]:
            raise ValueError(f"found rows {first} to {end}, there are {self.cycle.shape[0]}")
        for row in range(first, end):
            self.take(row)
            for n in range(self.count):
                self.observe(<JointCycle> at[n], n, row)
            if self.watches:
                self.contacts.watch(self.states)
            if self.flags[0, row] & WITHDRAWN:
                for n in range(self.count):
                    (<JointCycle> at[n]).withdraw(STALE)
                if self.watches:
                    self.contacts.withdraw(self.states)
            for n in range(self.count):
                memcpy(&self.to_samples[n, row, 0], &self.states[n].sample, sizeof(JointBlock))
                if self.states[n].shadow != NULL:
                    (<JointCycle> at[n]).observe_shadows()
                    memcpy(&self.to_samples[n, row, sizeof(JointBlock)], self.states[n].shadow, sizeof(ShadowBlock))
            for n in range(self.pdos):
                second = &self.states[2 * n + 1].published if 2 * n + 1 < self.count else &NOBODY
                encode_into(
                    &self.to_estimates[row, 8 * n], &self.states[2 * n].published, second, self.counter[row]
                )

    cdef void take(self, Py_ssize_t row) noexcept nogil:
        """Put the inputs of a row in place; where the frames give another temperature than the log, the log is right."""
        cdef Temperature *temperature
        cdef double logged
        cdef int n, m
        for n in range(self.intake.count):
            self.intake.inputs[n].fresh = self.fresh[n, row]
            for m in range(MOST_FIELDS):
                self.intake.inputs[n].values[m] = self.values[n, m, row]
        self.intake.age_temperatures(self.cycle[row])
        for n in range(self.intake.temperature_count):
            temperature, logged = &self.intake.celsius[n], self.celsius[n, row]
            if temperature.celsius != logged and not (isnan(logged) and isnan(temperature.celsius)):
                self.temperatures_from_log += 1
                temperature.celsius = logged

    cdef void observe(self, JointCycle joint, int number, Py_ssize_t row) noexcept nogil:
        """Estimate one joint in a row."""
        cdef bint starting
        joint.derived.is_replayed = self.with_velocity
        joint.derived.replayed_rad_s = self.velocity[number, row]
        cdef int flags = self.flags[number, row]
        joint.rules.at_most_degraded = (flags & UNCHECKED) != 0
        starting = self.cycle[row] < FIRST_CYCLES or (flags & STARTING) != 0
        joint.observe(self.sync_ns[number, row], starting, self.wanted[number, row])


def _checked(values, kind, shape):
    """Return an array of this type and shape; ValueError for another shape."""
    array = np.ascontiguousarray(values, kind).reshape(shape if np.size(values) == 0 else np.shape(values))
    if array.shape != shape:
        raise ValueError(f"found an array of shape {array.shape}, expected {shape}")
    return array
