"""Examples: run each as `python -m examples.NAME --help`.

hidden_effect     an effect is hidden in the emulated bench, found by a campaign and a diagnosis, and jtqd's gain is measured
kinova_diagnosis  the diagnosis of the seven joints of a measured arm, with the figures of docs/results.md
receivers         receive the estimate PDOs, in C, C++ and Python: to be copied into a controller
"""
