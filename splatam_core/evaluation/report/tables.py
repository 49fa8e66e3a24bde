"""Tables of results, as Markdown for a terminal and as a page for a browser."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import jinja2

from splatam_core.evaluation.report.theme import DARK, LIGHT

UNKNOWN = '\u2013'
TEMPLATE = 'tables.html'


@dataclass(frozen=True, slots=True)
class Table:
    """A table of texts.

    Attributes:
        title: what it shows; '' = the only table.
        columns: the headings.
        rows: one text per column each.
        links: first text of a row to the address that it leads to on a page.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    links: Mapping[str, str] = field(default_factory=dict)

    def markdown(self) -> str:
        """Return the table as Markdown, padded so that it is readable in a terminal."""
        widths = [max(map(len, cells)) for cells in zip(self.columns, *self.rows)]
        lines = [
            '| ' + ' | '.join(cell.ljust(width) for cell, width in zip(row, widths)) + ' |' for row in (self.columns, *self.rows)
        ]
        return '\n'.join([lines[0], '|' + '|'.join('-' * (width + 2) for width in widths) + '|', *lines[1:]])


def page(title: str, subtitle: str, tables: Sequence[Table], picture: str = '') -> str:
    """Return tables as a page that needs no other files, for light and dark screens.

    Args:
        title: of the page.
        subtitle: what the tables have in common.
        tables: from top to bottom.
        picture: a ``data:`` address to show below them; '' = none.
    """
    template = environment().get_template(TEMPLATE)
    return template.render(
        title=title, subtitle=subtitle, tables=tables, picture=picture, light=asdict(LIGHT), dark=asdict(DARK), unknown=UNKNOWN
    )


def environment() -> jinja2.Environment:
    """Return what renders the templates in this folder."""
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
