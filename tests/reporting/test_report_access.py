"""Laws of the page for every reader: contrast in light and dark, names of controls, structure."""

import json
import re
from collections import Counter
from collections.abc import Mapping
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

import sysid_bench.reporting
from sysid_bench.reporting.build_table import build_table
from sysid_bench.reporting.html import RunView, report_html
from tests.reporting.browser import shown

FOLDER = Path(sysid_bench.reporting.__file__).parent
CSS = (FOLDER / "report.css").read_text(encoding="utf-8")
TEXT, GRAPHICS = 4.5, 3.0  # least contrast: WCAG 2.2, 1.4.3 and 1.4.11
PAIRS = [
    (ink, paper, least)
    for inks, least in ((("ink", "soft", "accent", "bad"), TEXT), (("control", "one"), GRAPHICS))
    for ink in inks
    for paper in ("page", "tint")
]
VOID = ("meta", "br", "input", "link", "hr", "img")
# The luminance of every text that is shown, and of what is behind it.
CONTRAST = """
const part = v => v <= .04045 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4;
const light = ([r, g, b]) => .2126 * part(r / 255) + .7152 * part(g / 255) + .0722 * part(b / 255);
const parts = c => c.match(/[\\d.]+/g).map(Number);
const behind = e => {
  for (; e; e = e.parentElement) {
    const c = parts(getComputedStyle(e).backgroundColor);
    if (c.length < 4 || c[3] > 0) return c;
  }
  return [255, 255, 255];
};
const poor = [];
function look() {
  const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  let n = 0;
  while (walk.nextNode()) {
    const e = walk.currentNode.parentElement, text = walk.currentNode.textContent.trim();
    if (!text || !e.checkVisibility() || e.closest("svg, script, style, option")) continue;
    const ink = light(parts(getComputedStyle(e).color)), paper = light(behind(e));
    const ratio = (Math.max(ink, paper) + .05) / (Math.min(ink, paper) + .05);
    n += 1;
    if (ratio < 4.5) poor.push([e.tagName, e.className, ratio]);
  }
  document.body.dataset.looked = JSON.stringify({n, poor, page: behind(document.body)});
}
const wait = () => document.documentElement.dataset.ready ? look() : setTimeout(wait, 20);
wait();
"""


@pytest.fixture(scope="module")
def page(
    cells: pd.DataFrame,
    joints: pd.DataFrame,
    spec: Mapping[str, Any],
    tmp_path_factory: pytest.TempPathFactory,
) -> str:
    links = {str(cells["id"][0]): "artifacts/a/c.rrd"}
    suite = {"name": "smoke", "title": "Three robots"}
    tables, folder = (build_table(cells, spec),), tmp_path_factory.mktemp("run")
    run = RunView(folder, suite, {"python": "3"}, cells, joints, tables, links, "run smoke")
    return report_html(run)


def variables(dark: bool) -> dict[str, str]:
    """Colours of the page by name."""
    blocks = re.findall(r":root \{(.*?)\}", CSS, re.DOTALL)
    assert len(blocks) == 2
    colours: dict[str, str] = {}
    for block in blocks[: 1 + dark]:
        colours |= dict(re.findall(r"--(\w+): (#[0-9a-f]{6})", block))
    return colours


def luminance(colour: str) -> float:
    """Relative luminance of #rrggbb (WCAG 2.2)."""
    given = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in given]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: str, two: str) -> float:
    high, low = sorted((luminance(one), luminance(two)), reverse=True)
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize(("ink", "paper", "least"), PAIRS)
def test_colours_have_contrast(dark: bool, ink: str, paper: str, least: float) -> None:
    colours = variables(dark)
    assert contrast(colours[ink], colours[paper]) >= least


def test_contrast_is_that_of_the_standard() -> None:
    assert contrast("#000000", "#ffffff") == pytest.approx(21.0)
    assert contrast("#777777", "#ffffff") < TEXT < contrast("#767676", "#ffffff")


def test_every_colour_of_text_is_a_variable_of_both_schemes() -> None:
    rules = CSS.rsplit("}\n}", 1)[-1]
    assert not re.findall(r"#[0-9a-fA-F]{3,6}\b(?=[^{]*\})", rules)
    assert {"ink", "soft", "page", "tint", "accent", "bad"} <= set(variables(True))


class Page(HTMLParser):
    """Elements with their attributes, ancestors and text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[int] = []
        self.found: list[tuple[str, dict[str, str | None], list[str], list[str]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        above = [self.found[i][0] for i in self.open]
        self.found.append((tag, dict(attrs), above, []))
        if tag not in VOID:
            self.open.append(len(self.found) - 1)

    def handle_endtag(self, tag: str) -> None:
        while self.open and self.found[self.open.pop()][0] != tag:
            pass

    def handle_data(self, data: str) -> None:
        for i in self.open:
            self.found[i][3].append(data)


def faults(page: str) -> list[str]:
    """What a reader with a keyboard or a screen reader would miss, of the rules of axe-core."""
    found, wrong = Page(page).found, []
    ids = Counter(
        given["id"] for _, given, above, _ in found if "id" in given and "svg" not in above
    )
    wrong += [f"duplicate id {name}" for name, count in ids.items() if count > 1]
    level = 0
    for tag, given, above, texts in found:
        text = "".join(texts).strip()
        named = bool(text or given.get("aria-label") or given.get("title"))
        if tag == "html" and not given.get("lang"):
            wrong.append("html-has-lang")
        if tag in ("title", "button", "a", "summary") and not named:
            wrong.append(f"{tag} without a name")
        if tag in ("input", "select") and "label" not in above and not given.get("aria-label"):
            wrong.append(f"{tag} without a label")
        if tag == "th" and given.get("scope") not in ("col", "row"):
            wrong.append(f"th without scope: {text}")
        if given.get("role") in ("img", "region", "search") and not given.get("aria-label"):
            wrong.append(f"{given['role']} without a label")
        if given.get("class") == "scroll" and given.get("tabindex") != "0":
            wrong.append("scrollable-region-focusable")
        if int(given.get("tabindex") or 0) > 0:
            wrong.append("tabindex")
        if re.fullmatch("h[1-6]", tag):
            if int(tag[1]) > level + 1:
                wrong.append(f"heading-order: {text}")
            level = int(tag[1])
    inside = Page(page).found
    wrong += [f"no {tag}" for tag in ("main", "nav", "h1") if tag not in {one[0] for one in inside}]
    anchors = [str(given["href"])[1:] for tag, given, _, _ in found if tag == "a"]
    wrong += [f"link to nowhere: {name}" for name in anchors if name not in ids]
    return wrong


def test_controls_have_names_and_the_page_has_structure(page: str) -> None:
    assert faults(page) == []


@pytest.mark.parametrize(
    ("mistake", "fault"),
    [
        ('<input id="x">', "input without a label"),
        ("<table><tr><th>a</th></tr></table>", "th without scope: a"),
        ("<h2>a</h2><h4>b</h4>", "heading-order: b"),
        ('<div class="scroll"></div>', "scrollable-region-focusable"),
        ('<div role="img"></div>', "img without a label"),
        ('<a href="#gone">a</a>', "link to nowhere: gone"),
        ("<button></button>", "button without a name"),
        ('<p id="main"></p>', "duplicate id main"),
    ],
)
def test_faults_are_found(page: str, mistake: str, fault: str) -> None:
    assert faults(page.replace("</main>", f"{mistake}</main>")) == [fault]


@pytest.mark.parametrize("dark", [False, True])
def test_every_text_has_contrast_where_it_stands(
    page: str, cells: pd.DataFrame, tmp_path: Path, dark: bool
) -> None:
    file = tmp_path / "page.html"
    file.write_text(page.replace("</body>", f"<script>{CONTRAST}</script></body>"))
    dom = shown(file, tmp_path / "profile", "open=" + ",".join(cells["id"][:2]), dark)
    found = re.search(r'data-looked="([^"]*)"', dom)
    assert found is not None
    looked = json.loads(found[1].replace("&quot;", '"'))
    assert looked["n"] > 300
    assert looked["poor"] == []
    assert (sum(looked["page"]) < 150) == dark
