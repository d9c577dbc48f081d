"""Texts in columns, as papers print a model or its parameters: Markdown, CSV, LaTeX, JSON."""

import json
from dataclasses import asdict, dataclass

from sysid_bench.csv_text import csv_text
from sysid_bench.reporting import latex
from sysid_bench.reporting.latex import label_name
from sysid_bench.reporting.latex import latex_text as escape_latex
from sysid_bench.reporting.writers import markdown_text, table_line


@dataclass(frozen=True)
class TextTable:
    """A head and rows of as many texts; `notes` are sentences below."""

    name: str
    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()


def to_markdown(listing: TextTable) -> str:
    """Title, a pipe table, its notes."""
    head, *rows = (tuple(map(markdown_text, line)) for line in (listing.head, *listing.rows))
    table = "\n".join(map(table_line, [head, ("---",) * len(head), *rows]))
    return (
        "\n\n".join(
            [f"**{markdown_text(listing.title)}**", table, *map(markdown_text, listing.notes)]
        )
        + "\n"
    )


def to_csv(listing: TextTable) -> str:
    """The head, then a line per row."""
    return csv_text([listing.head, *listing.rows])


def to_json(listing: TextTable) -> str:
    """An object with name, title, head, rows and notes."""
    return json.dumps(asdict(listing), indent=1, ensure_ascii=False) + "\n"


def to_latex(listing: TextTable, origin: latex.Origin) -> str:
    """A `table` float; needs booktabs alone."""
    head, *rows = (
        latex.table_line(map(escape_latex, row)) for row in (listing.head, *listing.rows)
    )
    notes = latex.notes_text(list(map(escape_latex, listing.notes)))
    return (
        f"{latex.origin_text(origin)}\\begin{{table}}\n\\centering\n"
        f"\\caption{{{escape_latex(listing.title)}}}\n"
        f"\\label{{tab:{label_name(listing.name)}}}\n\\smallskip\n"
        f"\\footnotesize\n{latex.BOX}\\begin{{tabular}}{{@{{}}{'l' * len(listing.head)}@{{}}}}\n"
        f"\\toprule\n{head}\\midrule\n{''.join(rows)}\\bottomrule\n\\end{{tabular}}"
        f"{latex.FITTED}{notes}\n\\end{{table}}\n"
    )
