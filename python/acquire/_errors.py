"""Exceptions and warnings."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from typing import Any


class Error(Exception):
    """What :mod:`acquire` raises; the text is that of the command line, which names file and field.

    ``kind`` is the error's name in the library: ``Io``, ``MatrixFormat``, ``NotFinite``, ``Setting``, …
    """

    def __init__(self, text: str, kind: str = "") -> None:
        super().__init__(text)
        self.kind = kind


class InputError(Error):
    """The input, an option or the surroundings cannot be used (exit status 1 of the program)."""


class InternalError(Error):
    """A fault of acquire itself (exit status 2 of the program)."""


class FindingWarning(UserWarning):
    """A finding that did not stop the work; ``docs/findings.md`` lists them.

    ``finding`` is the record: ``id``, ``severity``, ``topic``, ``seen``, ``bound``, ``culprit``, ``done`` and the ``figures``.
    """

    def __init__(self, finding: dict[str, Any]) -> None:
        super().__init__(f"{finding['id']}: {finding['seen']}")
        self.finding = finding


def tell(findings: Iterable[dict[str, Any]], stacklevel: int = 3) -> None:
    """Findings as Python's warnings; notes are only in the report."""
    for finding in findings:
        if finding["severity"] != "note":
            warnings.warn(FindingWarning(finding), stacklevel=stacklevel)
