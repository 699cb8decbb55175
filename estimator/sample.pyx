"""One sample of a joint, what an estimator makes of it, and the class that all estimators share."""

from libc.math cimport NAN
from libc.string cimport memset

import numpy as np

from jtqd.estimator import status as st
from jtqd.estimator.run import EstimateRun
from jtqd.estimator.status import Estimate

cdef int INVALID = st.INVALID


cdef void no_values(Values *out, int status) noexcept nogil:
    """Set `out` to a status without any number."""
    out.torque_nm = out.sigma_nm = out.tob_nm = out.physics_nm = out.network_nm = NAN
    out.torque_rate_nm_s = out.load_nm = NAN
    out.status = status


cdef class Estimator:
    """Estimator of one joint: `advance` is the one step there is; the loop, `step` and `run` call it.

    Attributes:
        joint, settings: what it was made of.
    """

    cdef void advance(self, const Sample *sample, bint network_wanted, Values *out) noexcept nogil:
        """Set `out` to the estimate at this sample; without `network_wanted` there is no time for the network."""

    cdef double ask(self) noexcept with gil:
        """Return the answer for `features` of a network that is not evaluated natively; NaN where it fails."""
        cdef int n
        try:
            return self.run_one(*[self.features[n] for n in range(self.width)])
        except Exception:
            return NAN

    cdef const void *learned(self, Learned *out, size_t *size) noexcept nogil:
        """Set `out` to what is known of the zeros; return the estimator's whole state and its `size`.

        An estimator that learns nothing: no flag is set, and NULL is returned.
        """
        memset(out, 0, sizeof(Learned))
        size[0] = 0
        return NULL

    @property
    def with_network(self):
        """Whether a network is used."""
        raise NotImplementedError

    def reset(self):
        """Forget the past: the next step starts."""
        raise NotImplementedError

    def step(
        self,
        double dt_s,
        double current_a,
        double motor_position_rad,
        double motor_velocity_rad_s,
        double link_position_rad,
        double temperature_c=NAN,
        bint network_wanted=True,
    ):
        """Return the `Estimate` at this sample, dt_s [s] after the one before; never raises on any float.

        temperature_c: of the joint, NaN where it is not known. Without network_wanted there is no time for the network:
        this sample is physics only.
        """
        cdef Sample sample = Sample(
            dt_s, current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad, temperature_c
        )
        cdef Values out
        no_values(&out, INVALID)  # of an estimator that raises, which Python prints
        self.advance(&sample, network_wanted, &out)
        return Estimate(out.torque_nm, out.sigma_nm, out.status, out.tob_nm, out.physics_nm, out.network_nm)

    def run(
        self,
        dt_s,
        current_a,
        motor_position_rad,
        motor_velocity_rad_s,
        link_position_rad,
        temperature_c=None,
        network_wanted=None,
    ):
        """Return the estimates of a run as an `EstimateRun`: `step` for every sample of arrays [n].

        dt_s[k] is the time since sample k-1; temperature_c, network_wanted: None for NaN and True throughout.
        Raises ValueError for arrays of different length.
        """
        inputs = columns(dt_s, current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad, temperature_c)
        n = inputs.shape[1]
        wanted = np.ones(n, np.uint8) if network_wanted is None else np.ascontiguousarray(network_wanted, np.uint8)
        values, features, status = np.empty((5, n)), np.full((n, self.width), NAN), np.empty(n, np.uint8)
        cdef const double[:, ::1] x = inputs
        cdef const unsigned char[::1] w = wanted
        cdef double[:, ::1] to = values
        cdef double[:, ::1] f = features
        cdef unsigned char[::1] s = status
        cdef Sample sample
        cdef Values out
        cdef Py_ssize_t k
        cdef int m
        if w.shape[0] != x.shape[1]:
            raise ValueError(f"found {w.shape[0]} values of network_wanted, expected {n}")
        with nogil:
            for k in range(x.shape[1]):
                sample = Sample(x[0, k], x[1, k], x[2, k], x[3, k], x[4, k], x[5, k])
                no_values(&out, INVALID)
                self.observed = False
                self.advance(&sample, w[k], &out)
                to[0, k], to[1, k] = out.torque_nm, out.sigma_nm
                to[2, k], to[3, k], to[4, k] = out.tob_nm, out.physics_nm, out.network_nm
                s[k] = out.status
                if self.observed:
                    for m in range(self.width):
                        f[k, m] = self.features[m]
        torque, sigma, tob, physics, network = values
        return EstimateRun(torque, sigma, status, tob, physics, network, features)


def columns(*arrays):
    """Return columns of a run as one array [columns, n], None as NaN; ValueError for different lengths."""
    given = [np.asarray(each, np.float64) for each in arrays if each is not None]
    if len({each.shape for each in given}) != 1 or given[0].ndim != 1:
        raise ValueError(f"found arrays of shapes {[each.shape for each in given]}, expected all of one length")
    laid = np.full((len(arrays), len(given[0])), NAN)
    for k, each in enumerate(arrays):
        if each is not None:
            laid[k] = each
    return laid


cdef class PythonEstimator(Estimator):
    """Estimator written in Python, for the compiled loop: `inner` has `step` and `reset`, and perhaps the rest."""

    cdef readonly object inner

    def __init__(self, inner):
        self.inner = inner
        self.joint, self.settings = getattr(inner, "joint", None), getattr(inner, "settings", None)

    cdef void advance(self, const Sample *sample, bint network_wanted, Values *out) noexcept nogil:
        with gil:
            e = self.inner.step(
                sample.dt_s,
                sample.current_a,
                sample.motor_position_rad,
                sample.motor_velocity_rad_s,
                sample.link_position_rad,
                sample.temperature_c,
                bool(network_wanted),
            )
            out.torque_nm, out.sigma_nm, out.status = e.torque_nm, e.sigma_nm, e.status
            out.tob_nm, out.physics_nm, out.network_nm = e.tob_nm, e.physics_nm, e.network_nm

    @property
    def with_network(self):
        """Whether a network is used."""
        return self.inner.with_network

    def reset(self):
        """Forget the past: the next step starts."""
        self.inner.reset()
