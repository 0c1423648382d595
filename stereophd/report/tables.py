"""Tables of texts for readers: one form, and its text for the terminal; `report.page` has the form of the page."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

# The table whose cells are sentences.
CHECKS = "Checks"


@dataclass(frozen=True)
class SummaryTable:
    """A table of texts."""

    title: str  # "": none
    header: tuple[str, ...]  # (): none
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()  # Lines below the table
    words: tuple[int, ...] = (0,)  # Columns of words: to the left; those of numbers are to the right


def table_text(table: SummaryTable) -> str:
    """Return a table as text for a terminal: its title, and its rows and notes indented below it."""
    if table.title == CHECKS:
        lines = [
            f"{name} ({camera}): {state}{'' if remedy == '-' else f'. Remedy: {remedy}.'}"
            for name, camera, state, remedy in table.rows
        ]
    else:
        head = [table.header] if table.header else []
        lines = aligned([*head, *table.rows], table.words) if table.rows else []
    indent = "  " if table.title else ""
    return "\n".join([*([table.title] if table.title else []), *(f"{indent}{line}" for line in (*lines, *table.notes))])


def aligned(rows: Sequence[Sequence[str]], words: Collection[int] = (0,)) -> list[str]:
    """Return rows as lines with aligned columns: those of words to the left, the others to the right."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = (
            cell.ljust(width) if column in words else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        lines.append("  ".join(cells).rstrip())
    return lines
