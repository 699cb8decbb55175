"""Train networks on runs: `jtq train`, the paper's network and ours, exported as ONNX with a model card.

In: runs, joint files. Out: jointN.onnx or jointN.fused.onnx, card and figure. Modules: `command`, `network` (training,
export, the paper's network), `current_path` (ours, with the rule that accepts it). Needs torch and onnx: extra `train`.
"""
