"""Fit sections of a joint file to measured runs: `jtq fit efficiency|friction|losses`.

In: runs, a joint file. Out: a joint file with the fitted section and its provenance, reports, figures. Modules: `command`;
`plateaus` (with friction at no load) and `efficiency`; `signals`, `losses`, `torsion`, `calibration` and `fused` (the whole
section); `few_runs`; `joint_writer`.
"""
