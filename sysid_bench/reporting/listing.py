"""Texts in columns, as papers print a model or its parameters: Markdown, CSV, LaTeX."""

import csv
import io
from dataclasses import dataclass

from sysid_bench.reporting import latex
from sysid_bench.reporting.markdown import escape


@dataclass(frozen=True)
class Listing:
    """A head and rows of as many texts; `notes` are sentences below."""

    name: str
    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()


def to_markdown(listing: Listing) -> str:
    """Title, a pipe table, its notes."""
    lines = [listing.head, ("---",) * len(listing.head), *listing.rows]
    table = "\n".join(
        "| " + " | ".join(cell if k == 1 else escape(cell) for cell in line) + " |"
        for k, line in enumerate(lines)
    )
    return "\n\n".join([f"**{escape(listing.title)}**", table, *map(escape, listing.notes)]) + "\n"


def to_csv(listing: Listing) -> str:
    """The head, then a line per row."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([listing.head, *listing.rows])
    return out.getvalue()


def to_latex(listing: Listing, origin: latex.Origin) -> str:
    """A `table` float; needs booktabs alone."""
    body = "\n".join(" & ".join(map(latex.escape, row)) + r" \\" for row in listing.rows)
    head = " & ".join(map(latex.escape, listing.head)) + r" \\"
    notes = "".join(
        f"\n\n\\smallskip\n{{\\footnotesize {latex.escape(note)}\\par}}" for note in listing.notes
    )
    return (
        f"{latex.origin_text(origin)}\\begin{{table}}\n\\centering\n"
        f"\\caption{{{latex.escape(listing.title)}}}\n"
        f"\\label{{tab:{latex.label_name(listing.name)}}}\n\\smallskip\n"
        f"\\footnotesize\n\\begin{{tabular}}{{@{{}}{'l' * len(listing.head)}@{{}}}}\n\\toprule\n"
        f"{head}\n\\midrule\n{body}\n\\bottomrule\n\\end{{tabular}}{notes}\n\\end{{table}}\n"
    )
