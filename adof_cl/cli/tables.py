"""Tables on standard output, never cut: a number with its end missing is a wrong number."""

from __future__ import annotations

from rich.console import Console
from rich.measure import Measurement
from rich.table import Table


def print_table(table: Table) -> None:
    """Print a table as wide as its content, whatever the terminal's width; brackets stand for themselves."""
    console = Console(markup=False)
    wanted = Measurement.get(console, console.options.update(max_width=10_000), table).maximum
    Console(width=max(wanted, 1), markup=False).print(table)
