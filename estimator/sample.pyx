"""One sample of a joint, what an estimator makes of it, and the class that all estimators share."""

from libc.math cimport NAN

from jtqd.estimator.status import Estimate


cdef class Estimator:
    """Estimator of one joint; `advance` is the step that the loop calls, `step` the same for Python.

    Attributes:
        joint, settings: what it was made of.
    """

    cdef void advance(self, const Sample *sample, bint network_wanted, Values *out) noexcept nogil:
        """Set `out` to the estimate at this sample; without `network_wanted` there is no time for the network."""

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
        self.advance(&sample, network_wanted, &out)
        return Estimate(out.torque_nm, out.sigma_nm, out.status, out.tob_nm, out.physics_nm, out.network_nm)


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
