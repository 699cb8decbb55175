"""Identification of an arm from its own motion: `jtq fit arm`.

In: logs of `jtqd-arm`, ARM.yaml with the URDF of CAD. Out: a URDF and an ARM.yaml with what free motion leaves. Modules:
`command`, `fit`, `identification` (pure).
"""
