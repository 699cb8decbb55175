"""Train networks on runs: `jtq train`, the paper's network and ours, exported as ONNX with a model card.

In: runs, joint files. Out: jointN.onnx or jointN.fused.onnx, card and figure. Modules: `command`, `paper`, `ours` (with the
rule that accepts a network), `network` (training and export, needs torch and onnx: extra `train`).
Imports estimator, models, sysid.fit, sysid.runs.
"""
