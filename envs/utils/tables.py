"""Tables on the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def print_table(columns: Sequence[str], rows: Iterable[Sequence[str]], *, title: str = "", text: int = 1) -> None:
    """Print a table, whose words are never broken.

    A terminal that is too narrow for the longest words gets lines that are longer than its width; a pipe or a file gets
    one line for each line of a cell.

    Args:
        columns: titles of the columns.
        rows: cells of each row, which may have several lines.
        title: title of the table; an empty text prints none.
        text: number of columns, from the first, that are aligned on the left; numbers are aligned on the right.

    """
    from rich import box
    from rich.console import Console
    from rich.measure import Measurement
    from rich.table import Table

    table = Table(title=title or None, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for k, column in enumerate(columns):
        table.add_column(column, justify="left" if k < text else "right", no_wrap=k >= text)
    for row in rows:
        table.add_row(*row)
    console = Console(markup=False, highlight=False)
    size = Measurement.get(console, console.options.update(max_width=10_000), table)
    console.width = max(console.width, size.minimum) if console.is_terminal else size.maximum
    console.print(table)
