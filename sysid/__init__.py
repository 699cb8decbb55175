"""Identification: runs recorded or emulated, fits, networks, evaluation, and the diagnosis of what a model lacks.

Run files, joint files and a bus in; joint files, networks, findings and reports out, one command of `jtq` per folder.
Imports estimator, models, drivers, sim_can and the logs of daemon; scipy, torch, onnx, matplotlib where they are needed.
"""
