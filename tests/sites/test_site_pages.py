"""Laws of a results site: the same bytes, offline, escaped, every link leads somewhere, and the
leaderboard meets its schema."""

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from html import unescape
from pathlib import PurePosixPath
from typing import Any

import pandas as pd
import pytest

from sysid_bench.apps.site.site_pages import site_pages
from sysid_bench.apps.site.suite_version import (
    RepeatShare,
    SiteRun,
    Submission,
    group_by_version,
    page_name,
)
from sysid_bench.reporting.ranking_figures import CostPoint, _time_ticks, find_best
from tests.reporting.conftest import fabricate

EVIL = "<script>alert('x')</script>\"&../../x"
SUITE = {"name": "smoke", "title": "Arms", "seed": 1, "defaults": {"noise": [{}]}}


def some_run(folder: str = "one", robots: int = 2, **suite: Any) -> SiteRun:
    cells = fabricate(repeats=2, robots=tuple(f"robot{i}" for i in range(robots)))
    plants = ["matched" if i % 16 < 8 else "L2" for i in range(len(cells))]
    cells = cells.assign(plant=plants, seconds_cpu=cells["seconds"])
    env = {"python": "3.11.7", "cpu": "x", "versions": {"sysid-bench": "0.1.0"}}
    return SiteRun(
        name=folder,
        suite={**SUITE, **suite},
        env=env,
        cells=cells,
        planned=len(cells) + 3,
        choose=lambda text, cell: True,
        methods={"ols": '{"use":"ols"}', "wls": '{"use":"wls"}'},
    )


def hostile_run() -> SiteRun:
    run = some_run("<i>&", title=EVIL, name=EVIL)
    cells = run.cells.replace({"robot0": EVIL, "ols": EVIL + "2", "L2": EVIL + "3"})
    return replace(
        run,
        cells=cells.assign(reason=EVIL),
        env={"cpu": EVIL, "python": EVIL, "git": {"commit": EVIL}},
        submission=Submission(EVIL, EVIL, "javascript:alert(1)", EVIL),
        checked=RepeatShare(3, 40, ("0123456789ab",)),
    )


def recorded_run() -> SiteRun:
    run = some_run("three", name="real")
    ids = [f"d{i:011x}" for i in range(len(run.cells))]
    errors = run.cells["torque_error"].where(run.cells["noise"] != "exact", 7.77e5)
    cells = run.cells.assign(plant="recorded", id=ids, torque_error=errors)
    return replace(run, cells=cells[cells["robot"] == "robot1"])


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    return site_pages([some_run(), hostile_run(), recorded_run()])


def test_the_same_runs_give_the_same_bytes(pages: Mapping[str, str]) -> None:
    runs = (some_run(), hostile_run(), recorded_run())
    again = [replace(run, cells=pd.DataFrame(run.cells.to_dict("records"))) for run in runs]
    assert site_pages(again) == pages


def test_names_of_users_stay_text(pages: Mapping[str, str]) -> None:
    for path, text in pages.items():
        assert re.fullmatch(r"[a-z0-9_/.-]+", path)
        assert ".." not in path
        if path.endswith(".html"):
            assert "<script" not in text
            assert "<i>" not in text
            assert 'href="javascript' not in text
    assert unescape(pages["index.html"]).count(EVIL) >= 4


def test_nothing_is_fetched(pages: Mapping[str, str]) -> None:
    for path, text in pages.items():
        if path.endswith(".html"):
            assert "default-src 'none'" in text
            assert not re.search(r"""(?:src|url|@import)\s*[=(]\s*["']?(?:https?:)?//""", text)


def test_pages_are_for_every_reader(pages: Mapping[str, str]) -> None:
    for path, text in pages.items():
        if not path.endswith(".html"):
            continue
        assert text.startswith('<!doctype html>\n<html lang="en">')
        assert text.count("<h1>") == text.count("<title>") == text.count("<main") == 1
        # Figures are drawings with a name; their own ids are of glyphs, and the same in each.
        plain = re.sub(r"<svg.*?</svg>", "", text, flags=re.DOTALL)
        assert plain.count('role="img" aria-label="') == text.count("<svg")
        assert plain.count('class="scroll"') == plain.count('class="scroll" tabindex="0" role=')
        ids = re.findall(r' id="([^"]+)"', plain)
        assert len(ids) == len(set(ids))
        heads = re.findall(r"<th[ >][^>]*", plain)
        assert all("scope=" in head for head in heads)


def test_every_link_leads_to_a_page(pages: Mapping[str, str]) -> None:
    for path, text in pages.items():
        for link in re.findall(r'href="([^"]+)"', text):
            target, _, part = link.partition("#")
            parts = list(PurePosixPath(path).parent.parts)
            for word in PurePosixPath(target).parts:
                parts = parts[:-1] if word == ".." else [*parts, word]
            page = "/".join(parts) if target else path
            assert page in pages, link
            assert not part or f'id="{part}"' in pages[page], link


def test_every_robot_method_and_suite_has_a_page(pages: Mapping[str, str]) -> None:
    names = {
        "robots": {"robot0", "robot1", EVIL},
        "methods": {"ols", "wls", EVIL + "2"},
    }
    for folder, known in names.items():
        found = {path for path in pages if path.startswith(f"{folder}/")}
        assert found == {f"{folder}/{page_name(name)}.html" for name in known}
    assert sum(path.startswith("suites/") for path in pages) == 3


def test_a_suite_page_has_ranks_profiles_costs_levels_and_limitations(
    pages: Mapping[str, str],
) -> None:
    page = next(text for path, text in pages.items() if path.startswith("suites/smoke"))
    for part in ("rankings", "figures", "scores", "levels", "limitations", "failures", "runs"):
        assert f'id="{part}"' in page
    assert page.count("<figure>") == 4
    assert "3 planned cells of one have no row." in page


def test_exact_errors_are_in_no_number_of_noisy_data(pages: Mapping[str, str]) -> None:
    page = next(text for path, text in pages.items() if path.startswith("suites/real"))
    noisy, exact = page[page.index('id="scores"') :].split("<h3>Exact data")
    assert "7.77" not in noisy
    assert "7.77" in exact


def test_recorded_and_simulated_are_compared_where_a_robot_has_both(
    pages: Mapping[str, str],
) -> None:
    _, table = pages["index.html"].split('id="sources"')
    table = table[: table.index("</table>")]
    assert "robot1" in table
    assert "robot0" not in table


def test_runs_of_a_version_share_a_page_and_their_cells_count_once() -> None:
    more = some_run("two", estimator=[{"use": "tls"}], title="other")
    (version,) = group_by_version([some_run(), more])
    assert len(version.cells) == len(more.cells)
    assert len(group_by_version([some_run(), some_run("two", seed=2)])) == 2


def test_a_label_of_two_methods_is_two_methods() -> None:
    run = some_run()
    cells = run.cells.assign(id=[f"e{i:011x}" for i in range(len(run.cells))])
    other = replace(run, name="two", cells=cells, methods={**run.methods, "ols": '{"use":"my"}'})
    (version,) = group_by_version([run, other])
    assert set(version.cells["estimator"]) == {"ols", "wls", "ols (two)"}


def test_the_leaderboard_meets_its_schema(pages: Mapping[str, str]) -> None:
    schema = json.loads(pages["leaderboard.schema.json"])
    board = json.loads(pages["leaderboard.json"], parse_constant=pytest.fail)
    assert not list(faults(board, schema, "board"))
    broken = json.loads(pages["leaderboard.json"])
    del broken["suites"][0]["seed"]
    broken["suites"][1]["version"] = 3
    assert len(list(faults(broken, schema, "board"))) == 2


TYPES: dict[str, tuple[type, ...]] = {
    "object": (dict,), "array": (list,), "string": (str,), "null": (type(None),),
    "integer": (int,), "number": (int, float),
}  # fmt: skip


def faults(value: Any, schema: Mapping[str, Any], where: str) -> Any:
    """Where a value does not meet a schema, of the keywords that ours uses."""
    kinds = schema.get("type", list(TYPES))
    kinds = [kinds] if isinstance(kinds, str) else kinds
    if not any(isinstance(value, TYPES[kind]) for kind in kinds):
        yield f"{where}: {value!r} is not {kinds}"
        return
    if "const" in schema and value != schema["const"]:
        yield f"{where}: {value!r}"
    if isinstance(value, str) and not re.search(schema.get("pattern", ""), value):
        yield f"{where}: {value!r} has another form"
    if isinstance(value, (int, float)) and value < schema.get("minimum", value):
        yield f"{where}: {value} is too small"
    if isinstance(value, list):
        if not schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", len(value)):
            yield f"{where}: {len(value)} items"
        for i, item in enumerate(value):
            yield from faults(item, schema["items"], f"{where}[{i}]")
    if isinstance(value, dict):
        known, others = schema.get("properties", {}), schema.get("additionalProperties", {})
        yield from (f"{where}: no {key}" for key in schema.get("required", ()) if key not in value)
        for key, item in value.items():
            if key not in known and others is False:
                yield f"{where}: {key} is unknown"
            else:
                yield from faults(item, known.get(key, others), f"{where}.{key}")


def test_no_method_beats_those_of_the_front() -> None:
    points = tuple(
        CostPoint(str(i), 10.0 ** (i % 3), ((i * 7) % 11) / 10 + 0.1, None) for i in range(12)
    )
    front = find_best(points)
    for point in points:
        beaten = any(o.seconds <= point.seconds and o.ratio < point.ratio for o in points)
        quicker = any(o.seconds < point.seconds and o.ratio <= point.ratio for o in points)
        assert (point in front) == (not beaten and not quicker)


@pytest.mark.parametrize("span", [1.0, 1.3, 4.0, 99.0])
@pytest.mark.parametrize("least", [2e-4, 1.1e-3, 3.0])
def test_an_axis_of_times_has_numbers_within_them(least: float, span: float) -> None:
    ticks = _time_ticks([least, least * span])
    assert len(ticks) >= min(2, 1 + (span > 1))
    assert least <= ticks[0] <= ticks[-1] <= least * span
