"""Draw a day of the foreign arm: what pushes on a joint, what is estimated, when contact is reported.

python -m validation.arm.picture docs/figures/external_torque.png
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from validation.arm.arm import CYCLE_S, URDF, read
from validation.arm.judge import GAUSS
from validation.arm.product import jtqd_arm
from validation.arm.trial import Trial, User, error_process


def main() -> None:
    """Identify the arm, estimate a day with contacts and draw one joint of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--seed", type=int, default=38001)
    parser.add_argument("--plant", default="bad_day")
    parser.add_argument("--joint", type=int, default=2)
    parser.add_argument("--span", type=float, nargs=2, default=(14.0, 44.0))
    options = parser.parse_args()
    trial = Trial(options.plant, options.seed, 0)
    arm, joints = trial.arm, partial(error_process, plant=options.plant)
    weighed = trial.identification()
    truths = arm.record([each.run for each in weighed])
    known = [(read(arm, w.run, t, joints), w.payload) for w, t in zip(weighed, truths, strict=True)]
    values = arm.nominal
    constants = values["torque_constant_nm_per_a"], values["rotor_kgm2"]
    estimate = jtqd_arm(User(URDF, arm.rated_nm, arm.ratio, *constants, known))
    run = trial.contact(0)
    truth = arm.record([run])[0]
    found = estimate(read(arm, run, truth, joints))
    first, last = (round(each / CYCLE_S) for each in options.span)
    shown, j = slice(first, last, 5), options.joint - 1
    t = CYCLE_S * np.arange(len(truth.link_rad))[shown]
    value, half = found.external_nm[shown, j], GAUSS * found.sigma_nm[shown, j]
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.fill_between(t, value - half, value + half, color="tab:blue", alpha=0.2, lw=0, label="90 % interval")
    axes.plot(t, value, color="tab:blue", lw=0.8, label="estimated")
    axes.plot(t, truth.external_nm[shown, j], color="black", lw=1.2, label="truth")
    low = axes.get_ylim()[0]
    touched = found.contact[shown] > 0
    axes.fill_between(t, low, low + 0.6, where=touched, color="tab:red", lw=0, label="contact reported")
    for contact in run.contacts:
        if options.span[0] < contact.full_s < options.span[1]:
            size = float(np.linalg.norm(contact.force_n))
            text = f"{'clamp' if contact.kind == 'clamp' else 'push'} {size:.0f} N\nlink {contact.link}"
            axes.annotate(text, (contact.full_s, axes.get_ylim()[1]), fontsize=7, va="top", ha="left")
    axes.set(xlabel="time [s]", ylabel=f"external torque of joint {options.joint} [Nm]", xlim=options.span)
    figure.legend(loc="outside lower center", ncols=4, fontsize=7)
    figure.savefig(options.file, dpi=110)


if __name__ == "__main__":
    main()
