from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.joint import ContactWatch, JointCycle
from jtqd.estimator.arrays import BoolArray, CodeArray, FloatArray, IntegerArray

Codes = npt.NDArray[np.intc]

def fields(torque_nm: FloatArray, sigma_nm: FloatArray, status: CodeArray) -> tuple[Codes, Codes, Codes]: ...

class CycleRows:
    samples: npt.NDArray[np.uint8]
    estimates: npt.NDArray[np.uint8]
    temperatures_from_log: int
    def __init__(
        self,
        intake: Intake,
        joints: Sequence[JointCycle],
        *,
        fresh: BoolArray | Sequence[BoolArray],
        values: Sequence[Sequence[IntegerArray]],
        celsius: FloatArray | Sequence[FloatArray],
        cycle: npt.NDArray[np.integer],
        counter: npt.NDArray[np.integer],
        sync_ns: IntegerArray | Sequence[IntegerArray],
        wanted: BoolArray | Sequence[BoolArray],
        flags: Sequence[npt.NDArray[np.uint8]],
        velocity: FloatArray | Sequence[FloatArray] | None = None,
        contacts: ContactWatch | None = None,
    ) -> None: ...
    def go_on(self, first: int, end: int) -> None: ...
