"""One self-contained HTML report for all of sysid: page, figures, numbers; the contents are in the rooms that use it.

In: a template of the caller with its content, matplotlib figures, floats. Out: one HTML page, light and dark, and its SVG.
Modules: `page` (template and colours), `figures` (SVG and common parts of plots), `numbers` (numbers as text).
Imports jinja2 and matplotlib when a page or a figure is made, and nothing else of the project but estimator.arrays.
"""
