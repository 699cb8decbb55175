from collections.abc import Callable

class Noise:
    def __init__(self, uniform: Callable[[], float]) -> None: ...
