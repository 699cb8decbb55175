"""Tools of the project that no installation has: packaging, data sheets, and counters of lines and words.

`python tools/deb.py`, `python -m tools.release`, `python -m tools.eds`, `python -m tools.profiles`, `python -m tools.count`.
Nothing of the product imports them.
"""
