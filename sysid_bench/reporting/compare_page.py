"""Page of a comparison of two runs: tables with a filter, complete in one file."""

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Final

from sysid_bench.reporting.text_table import TextTable

MOST_ROWS: Final = 2000
"""Rows of a table in the page; a page of 5,000 cells stays below a megabyte."""
_STYLE: Final = (
    ":root{color-scheme:light dark;--line:#8884;--muted:#767676}"
    "body{font:15px/1.5 system-ui,sans-serif;max-width:80rem;margin:1.5rem auto;padding:0 1rem}"
    ".wide{overflow-x:auto}table{border-collapse:collapse;font-size:.9rem;min-width:100%}"
    "th,td{border-bottom:1px solid var(--line);padding:.3rem .6rem;text-align:left;"
    "white-space:nowrap}thead th{position:sticky;top:0;background:Canvas}"
    "input{font:inherit;padding:.3rem;width:min(100%,24rem)}pre{overflow-x:auto}"
    ".note{color:var(--muted)}"
)
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
        f"<style>{_STYLE}</style><h1>{escape(title)}</h1>",
        *(f"<pre>{escape(note)}</pre>" for note in notes),
        *map(_section, listings),
        f"<script>{_SCRIPT}</script></html>\n",
    ]
    file.write_text("\n".join(parts), encoding="utf-8")


def _section(listing: TextTable) -> str:
    head = "".join(f"<th scope=col>{escape(text)}</th>" for text in listing.head)
    rows = "".join(map(_row, listing.rows[:MOST_ROWS]))
    more = len(listing.rows) - MOST_ROWS
    notes = [*listing.notes, *([f"{more} more rows are in --format json."] if more > 0 else [])]
    search = "<p><label>Filter <input type=search></label></p>" if len(listing.rows) > 8 else ""
    return (
        f"<section><h2>{escape(listing.title)}</h2>{search}<div class=wide><table><thead><tr>"
        f"{head}</tr></thead><tbody>{rows}</tbody></table></div>"
        + "".join(f"<p class=note>{escape(note)}</p>" for note in notes)
        + "</section>"
    )


def _row(texts: Sequence[str]) -> str:
    return f"<tr>{''.join(f'<td>{escape(text)}</td>' for text in texts)}</tr>"
