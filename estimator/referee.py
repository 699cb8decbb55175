"""Program: ONNX Runtime judges network files, `python -m jtqd.estimator.referee`.

Reads a JSON line [method, path, SHA-256 or null] per network, and answers each with a line: the fields of a `Verdict`, or
{"refused": why}.
"""

from __future__ import annotations

import json
import sys

from jtqd.estimator.methods import load_network
from jtqd.estimator.onnx_graph import NetworkError


def main() -> int:
    """Answer until the end of input. Returns 0."""
    for line in sys.stdin:
        method, path, sha256 = json.loads(line)
        try:
            answer = load_network(method, path, sha256).verdict()._asdict()
        except NetworkError as error:
            answer = {"refused": str(error)}
        print(json.dumps(answer), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
