"""Page of a comparison of two runs: tables with a filter, complete in one file."""

from collections.abc import Sequence
from html import escape
from itertools import repeat
from pathlib import Path
from typing import Final

from sysid_bench.reporting.text_table import TextTable

MOST_ROWS: Final = 2000
"""Rows of a table in the page; a page of 5,000 cells stays below a megabyte."""
_SCRIPT: Final = (
    "document.querySelectorAll('input').forEach(i=>i.oninput=()=>{"
    "const w=i.value.toLowerCase().split(/\\s+/);"
    "i.parentElement.parentElement.querySelectorAll('tbody tr').forEach(r=>{"
    "const t=r.textContent.toLowerCase();r.hidden=!w.every(x=>t.includes(x))})})"
)


def write_compare_page(
    file: Path, title: str, listings: Sequence[TextTable], notes: Sequence[str]
) -> None:
    """Write the tables and notes into an .html file; needs no network."""
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{escape(title)}</title>",
        "<meta name=viewport content='width=device-width,initial-scale=1'>",
        f"<style>{_style()}</style><h1>{escape(title)}</h1><main>",
        *(f"<pre>{escape(note)}</pre>" for note in notes),
        *map(_section, listings),
        f"</main><script>{_SCRIPT}</script></html>\n",
    ]
    file.write_text("\n".join(parts), encoding="utf-8")


def _style() -> str:
    """The style of report.html."""
    return Path(__file__).with_name("report.css").read_text(encoding="utf-8")


def _section(listing: TextTable) -> str:
    shown = listing.rows[:MOST_ROWS]
    classes = list(map(_class, zip(*shown, strict=True))) or [""] * len(listing.head)
    head = "".join(map(_cell, repeat("th scope=col"), listing.head, classes))
    rows = "".join(f"<tr>{''.join(map(_cell, repeat('td'), row, classes))}</tr>" for row in shown)
    more = len(listing.rows) - MOST_ROWS
    notes = [*listing.notes, *([f"{more} more rows are in --format json."] if more > 0 else [])]
    search = "<p><label>Filter <input type=search></label></p>" if len(listing.rows) > 8 else ""
    title = escape(listing.title)
    return (
        f"<section><h2>{title}</h2>{search}"
        f'<div class=scroll tabindex=0 role=region aria-label="{title}">'
        f"<table class=listing><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>"
        + "".join(f"<p class=soft>{escape(note)}</p>" for note in notes)
        + "</section>"
    )


def _class(texts: Sequence[str]) -> str:
    """Attribute of a column: numbers are aligned right."""
    numbers = [text for text in texts if text != "-"]
    return " class=n" if numbers and all(map(_is_number, numbers)) else ""


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _cell(tag: str, text: str, attribute: str) -> str:
    return f"<{tag}{attribute}>{escape(text)}</{tag.split()[0]}>"
