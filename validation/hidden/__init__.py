"""Hidden-effect generator: runs of a bench that is not quite what its joint files say.

Independent of the project on purpose: equations, integrator and measurement are written here again with numpy alone, so
that finding a hidden effect is not inverting one's own code. `draw` makes one set of runs, `draw_many` many at once.
"""

from validation.hidden.case import Case, draw, draw_many, follow_up, write
from validation.hidden.order import Hidden, Order

__all__ = ["Case", "Hidden", "Order", "draw", "draw_many", "follow_up", "write"]
