"""How good the estimate and the diagnosis are: studies on emulated, independent and measured benches.

Not part of the product: nothing of the wheel imports it. `python -m validation` lists the studies (README.md).
"""
