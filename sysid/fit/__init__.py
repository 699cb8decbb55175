"""Fit sections of a joint file to measured runs: `jtq fit efficiency|friction|losses`.

In: runs, a joint file. Out: a joint file with the fitted section and its provenance, reports, figures. Modules: `command`;
`efficiency` (Eq. 8), `friction` and `no_load`, `fused` with `losses` and `torsion`; `plateaus`, `signals`; `joint_writer`.
Imports estimator, models, sysid.runs, sysid.report; scipy only in `fused`.
"""

"""TODO."""
