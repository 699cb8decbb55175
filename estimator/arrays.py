"""Types of the arrays that pass between the parts: what one element is; shapes stand where a function takes them."""

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntegerArray = npt.NDArray[np.int64]
CodeArray = npt.NDArray[np.uint16]
StatusArray = npt.NDArray[np.uint8]
RecordArray = npt.NDArray[np.void]
"""Rows of a structured type, such as the messages of a topic."""
