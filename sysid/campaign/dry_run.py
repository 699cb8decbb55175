"""What a campaign would do: its runs, how long they take, and what the bus would carry. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from drivers.bus_load import LIMIT, BusLoad
from sysid.campaign.plan import Plan
from sysid.campaign.progress import BETWEEN_RUNS_S, clock_text
from sysid.campaign.segments import travel_rad
from sysid.motion.setpoints import Setpoints


def rows(plan: Plan, setpoints: Mapping[str, Setpoints]) -> list[dict[str, Any]]:
    """One row per run: name, velocity joint, segments, seconds, peaks of velocity and current, travel."""
    result = []
    for run in plan.runs:
        points = setpoints[run.name]
        result.append(
            {
                "run": run.name,
                "velocity_joint": run.velocity_joint,
                "segments": len(run.segments),
                "seconds": round(points.duration_s, 3),
                "peak_velocity_rad_s": round(float(np.abs(points.velocity_rad_s).max()), 4),
                "peak_current_a": round(float(np.abs(points.current_a).max()), 4),
                "travel_rad": round(travel_rad(points), 4),
            }
        )
    return result


def total_s(setpoints: Mapping[str, Setpoints]) -> float:
    """Expected length of the whole campaign, with what lies between the runs."""
    return sum(points.duration_s + BETWEEN_RUNS_S for points in setpoints.values())


def content(plan: Plan, setpoints: Mapping[str, Setpoints], load: BusLoad) -> dict[str, Any]:
    """For a program."""
    return {
        "schema": "jtq.campaign_plan/1",
        "name": plan.name,
        "plan_sha256": plan.sha256,
        "runs": rows(plan, setpoints),
        "motion_s": round(sum(points.duration_s for points in setpoints.values()), 3),
        "expected_s": round(total_s(setpoints), 1),
        "bus_load_worst": load.worst,
        "bus_load_limit": LIMIT,
    }


def text(plan: Plan, setpoints: Mapping[str, Setpoints], load: BusLoad) -> str:
    """For people."""
    table = rows(plan, setpoints)
    width = max(len("run"), *(len(row["run"]) for row in table))
    lines = [
        f"{'run':<{width}}  {'velocity joint':>14}  {'segments':>8}  {'seconds':>7}  {'peak rad/s':>10}  "
        f"{'peak A':>6}  {'travel rad':>10}"
    ]
    lines += [
        f"{row['run']:<{width}}  {row['velocity_joint']:>14}  {row['segments']:>8}  {row['seconds']:>7.1f}  "
        f"{row['peak_velocity_rad_s']:>10.2f}  {row['peak_current_a']:>6.2f}  {row['travel_rad']:>10.1f}"
        for row in table
    ]
    motion_s = sum(points.duration_s for points in setpoints.values())
    limits = plan.limits
    lines += [
        f"{len(table)} runs, {clock_text(motion_s)} of motion, about {clock_text(total_s(setpoints))} in all",
        f"limits: {limits.current_a:g} A, {limits.velocity_rad_s:g} rad/s, {limits.torque_nm:g} Nm, "
        f"{limits.travel_rad:g} rad, "
        + (
            f"{limits.temperature_c:g} °C"
            if math.isfinite(limits.temperature_c)
            else "temperature not supervised"
        ),
        f"bus load {load.worst:.1%} in the worst case, {load.worst * load.capacity_bits:.0f} of {load.capacity_bits:.0f} "
        f"bits in a cycle, limit {LIMIT:.0%}",
    ]
    return "\n".join(lines)
