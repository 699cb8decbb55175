"""SHA-256 as CPython computes it itself: hashlib would load OpenSSL, 3.4 MB in every process, for a few small files."""

from __future__ import annotations

from contextlib import suppress
from importlib import import_module
from typing import Any, Final


def _implementation() -> Any:
    """Return `sha256` of CPython up to 3.11, from 3.12 on, or of any other Python."""
    for module in ("_sha256", "_sha2"):
        with suppress(ImportError):
            return import_module(module).sha256
    return import_module("hashlib").sha256


sha256: Final = _implementation()


def sha256_hex(data: bytes) -> str:
    """Return the SHA-256 of some bytes in hexadecimal."""
    return str(sha256(data).hexdigest())
