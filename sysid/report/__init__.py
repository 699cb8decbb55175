"""One self-contained HTML report, light and dark, for all of sysid; the contents stand in the packages that use it.

In: a template of the caller with its content, matplotlib figures, floats. Out: one HTML page and its SVG.
Modules: `page` (template, colours, figures as SVG) and `numbers` (numbers as text).
"""
