"""User scripts of the viewers' layout: quantities of two fields, which a message path cannot form. Pure.

TypeScript as Foxglove and Lichtblick take it: `inputs`, `output` (a topic below /studio_script/) and a default
export that turns one message into one message. The viewer compiles and runs them; the daemon never does.
"""

from __future__ import annotations

from daemon.recording import schemas

_PREFIX = "/studio_script/"
JOINT_TOPICS = {1: f"{_PREFIX}joint_1", 2: f"{_PREFIX}joint_2"}
"""Joint -> topic with upper_nm, lower_nm, minus_sigma_nm, residual_nm [Nm]."""
CYCLE_TOPIC = f"{_PREFIX}cycle"
"""Topic with period_us, work_us, late_us [us]."""

_JOINT_SCRIPT = """\
// Sigma band of the estimate, and its residual to the torque sensor. NaN where either is not known.
import { Input } from "./types";

type Output = { upper_nm: number; lower_nm: number; minus_sigma_nm: number; residual_nm: number };

export const inputs = ["%(state)s"];
export const output = "%(output)s";

export default function script(event: Input<"%(state)s">): Output {
  const message = event.message;
  return {
    upper_nm: message.torque_nm + message.sigma_nm,
    lower_nm: message.torque_nm - message.sigma_nm,
    minus_sigma_nm: -message.sigma_nm,
    residual_nm: message.torque_nm - message.sensor_torque_nm,
  };
}
"""

_CYCLE_SCRIPT = """\
// Time since the SYNC before, and the cycle's work and lateness, all in us.
import { Input } from "./types";

type Output = { period_us: number; work_us: number; late_us: number };

export const inputs = ["%(frames)s"];
export const output = "%(output)s";

let before_s = 0;
let before_ns = 0;
let before_cycle = 0;

export default function script(event: Input<"%(frames)s">): Output {
  const message = event.message;
  const { sec, nsec } = message.header.stamp;
  const cycle = Number(message.cycle);
  const cycles = cycle - before_cycle;
  const passed_us = (sec - before_s) * 1e6 + (nsec - before_ns) / 1e3;
  before_s = sec;
  before_ns = nsec;
  before_cycle = cycle;
  // After a jump in the file there is nothing to compare with. Missed slots show as a long cycle; the live view
  // leaves out so many cycles that the mean of those between stands for them.
  const known = cycles > 0 && cycles < 1000 && passed_us > 0;
  return {
    period_us: known ? (cycles < 10 ? passed_us : passed_us / cycles) : NaN,
    work_us: message.work_ns / 1e3,
    late_us: message.late_ns / 1e3,
  };
}
"""


def scripts() -> dict[str, dict[str, str]]:
    """Identifier -> name and source code, as a layout's `userNodes` holds them."""
    made = {
        f"jtqd-joint-{joint}": {
            "name": f"joint_{joint}",
            "sourceCode": _JOINT_SCRIPT % {"state": topic.name, "output": JOINT_TOPICS[joint]},
        }
        for joint, topic in ((1, schemas.JOINT_1), (2, schemas.JOINT_2))
    }
    cycle = _CYCLE_SCRIPT % {"frames": schemas.CAN_FRAMES.name, "output": CYCLE_TOPIC}
    return made | {"jtqd-cycle": {"name": "cycle", "sourceCode": cycle}}
