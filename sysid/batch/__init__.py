"""One command over many logs: groups of logs as tasks, here or on a dask cluster, resumable, with one page at the end."""
