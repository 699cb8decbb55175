"""`jtq batch`: diagnose or replay many logs, here or on a dask cluster, with one summary page.

In: logs and run tables, options of the command. Out: one result per group of logs, kept by content; summary and page.
"""
