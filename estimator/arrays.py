"""Array types by element; shapes stand in the docstring of the function that takes them."""

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntegerArray = npt.NDArray[np.int64]
CodeArray = npt.NDArray[np.uint16]
QuadrantArray = npt.NDArray[np.intp]
StatusArray = npt.NDArray[np.uint8]
RecordArray = npt.NDArray[np.void]
"""Rows of a structured type, such as the messages of a topic."""
