"""`jtq schema`: JSON schema of the files that people write, for completion and checks in an editor.

It is made of what the decoder reads (`jtqd.estimator.decoder`); what two keys must agree in is not in it.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from typing import Any

from jtqd.daemon.config import ConfigFile
from jtqd.estimator.command_line import command_parser
from jtqd.estimator.decoder import json_schema
from jtqd.estimator.joint import Joint

_EXAMPLES = """examples:
  jtq schema config > jtqd.schema.json
  jtq schema joint > joint.schema.json
and as the first line of the file, for editors with the YAML language server:
  # yaml-language-server: $schema=jtqd.schema.json

exit status: 0, 2 usage"""
FILES = ("config", "joint", "plan")


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq schema`."""
    made = command_parser(
        "jtq schema", "Print the JSON schema of a configuration, joint file or plan.", _EXAMPLES
    )
    made.add_argument("file", choices=FILES, help="kind of file")
    return made


def schema_of(file: str) -> dict[str, Any]:
    """Return the JSON schema of one of FILES."""
    if file == "plan":  # a package above this one, loaded as `jtq` loads its commands
        found = importlib.import_module("jtqd.sysid.planner.plan").plan_schema()
    else:
        found = json_schema({"config": ConfigFile, "joint": Joint}[file])
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": f"jtqd: {file}", **found}


def main(argv: list[str]) -> int:
    """Print a schema; returns the exit status."""
    print(json.dumps(schema_of(parser().parse_args(argv).file), indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
