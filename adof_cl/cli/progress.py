"""Progress on standard error: one live line for people, plain lines where nobody watches."""

from __future__ import annotations

import sys
from types import TracebackType

from rich.console import Console
from rich.status import Status


class Live:
    """A context that shows (stage, sentence) as they come.

    On a terminal the last sentence stays in place and each finished stage leaves its own line; elsewhere the
    first and last sentence of each stage are printed.
    """

    def __init__(self, title: str) -> None:
        self._console = Console(stderr=True, highlight=False)
        self._watched = sys.stderr.isatty()
        self._status: Status | None = None
        self._title = title
        self._stage = ""
        self._last = ""

    def __enter__(self) -> Live:
        self._console.print(self._title, markup=False, soft_wrap=True)
        if self._watched:
            self._status = self._console.status("")
            self._status.start()
        return self

    def tell(self, stage: str, sentence: str) -> None:
        """Show what is going on."""
        if stage != self._stage:
            self._finish_stage()
            self._stage = stage
            if not self._watched:
                self._console.print(f"  {stage}: {sentence}", markup=False, soft_wrap=True)
        self._last = sentence
        if self._status is not None:
            self._status.update(f"{stage}: {sentence}")

    def _finish_stage(self) -> None:
        if self._stage:
            self._console.print(f"  {self._stage}: {self._last}", markup=False, soft_wrap=True)

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._status is not None:
            self._status.stop()
        self._finish_stage()
