"""Fit sections of a joint file to measured runs: `jtq fit efficiency|friction|losses`.

In: runs, a joint file. Out: a joint file with the fitted section and its provenance, reports, figures. Modules: `command`;
`plateaus` with `efficiency` and `friction`; `signals` with `fused` (the whole fit), `losses`, `few_runs`, `torsion`,
`residuals`, `calibration`, `repeatability`, `envelope`; `joint_writer`. Imports estimator, models, sysid.runs, sysid.report.
"""
