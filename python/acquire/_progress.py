"""Progress: bars of our own on a terminal, tqdm's in a notebook, else none."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, Union

#: ``True``: where somebody looks; ``False``: never; a callable: ``(stage, steps done, steps in all)``, some times a second.
Progress = Union[bool, Callable[[str, int, int], None]]


def in_notebook() -> bool:
    """Whether a Jupyter kernel runs this."""
    shell = sys.modules.get("IPython")
    instance = shell.get_ipython() if shell is not None else None
    return instance is not None and type(instance).__name__ == "ZMQInteractiveShell"


class _Tqdm:
    def __init__(self) -> None:
        self.bar: Any = None
        self.stage = ""

    def __call__(self, stage: str, done: int, total: int) -> None:
        from tqdm.auto import tqdm

        if self.bar is None or self.stage != stage:
            if self.bar is not None:
                self.bar.close()
            self.bar, self.stage = tqdm(total=total, desc=stage, leave=False), stage
        self.bar.n = done
        self.bar.refresh()


def report(progress: Progress) -> Any:
    """What the native part takes: nothing, True for its own bars, or a callable."""
    if callable(progress):
        return progress
    if not progress:
        return None
    if in_notebook():
        try:
            import tqdm.auto  # noqa: F401
        except ImportError:
            return None
        return _Tqdm()
    return True if sys.stderr is not None and sys.stderr.isatty() else None
