"""Laws of content: one thing has one id and one seed, however its path is written."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import sysid_bench
from sysid_bench.errors import SysidBenchError, UsageError
from sysid_bench.experiments.spec import held_out_seed, motion_seed, noise_seed, plant_seed
from sysid_bench.harness.cell import Cell
from sysid_bench.harness.comparison.baseline import baseline_of, from_text, to_text
from sysid_bench.harness.comparison.run_difference import find_difference
from sysid_bench.harness.comparison.run_values import read_run
from sysid_bench.harness.plan import Plan, cells_of_suite
from sysid_bench.harness.run import run
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.load_suite import parse_suite
from sysid_bench.harness.suite.names import default_names
from sysid_bench.package_folders import package_folder

ARM = """<mujoco><compiler angle="radian" autolimits="true"/><worldbody>
 <body name="upper"><joint name="j1" axis="0 0 1" range="-2 2" damping="0.1"/>
  <inertial mass="3" pos="0.1 0 0" diaginertia="0.02 0.03 0.03"/>
  <body name="fore" pos="0.3 0 0"><joint name="j2" axis="0 1 0" range="-2 2"/>
   <inertial mass="1.5" pos="0.1 0 0.02" diaginertia="0.01 0.02 0.02"/>
  </body></body></worldbody></mujoco>"""
HEAVY = ARM.replace('mass="3"', 'mass="3.1"')
COMMENT = ARM.replace("<worldbody>", "<worldbody><!-- one -->")


def suite_text(robots: str, motion: str = '"fourier"', more: str = "") -> str:
    return f"""schema = 1
name = "content"
[run]
repeats = 2
[defaults]
excitation = {motion}
held_out   = [["fourier-other"]]
rate       = "50 Hz"
noise      = {{ tau = "1 %" }}
signals    = {{ filter = "none", derivatives = "exact" }}
[[robot]]
use = {robots}
{more}
[[estimator]]
use = "ols"
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "arm.xml").write_text(ARM)
    return tmp_path


def planned(folder: Path, text: str, robots: Path | None = None) -> Plan:
    names = default_names(robots)
    return cells_of_suite(parse_suite(text, "s.toml", folder, names), names)


def identity(cell: Cell) -> tuple[object, ...]:
    seeds = (motion_seed(cell.spec), noise_seed(cell.spec), plant_seed(cell.spec))
    return cell.id, *seeds, held_out_seed(cell.spec, 0)


@pytest.mark.parametrize(
    "spelling",
    ["own/arm.xml", "file:own/arm.xml", "./own/arm.xml", "own/../own/arm.xml", "link.xml", "{}"],
)
def test_a_path_may_be_written_in_many_ways(spelling: str, folder: Path) -> None:
    (folder / "link.xml").symlink_to("own/arm.xml")
    written = spelling.format(folder / "own" / "arm.xml")
    cells = [planned(folder, suite_text(f'"{one}"')).cells for one in ("file:own/arm.xml", written)]
    assert [identity(cell) for cell in cells[0]] == [identity(cell) for cell in cells[1]]


@pytest.mark.parametrize(("text", "is_same"), [(ARM, True), (COMMENT, True), (HEAVY, False)])
def test_another_model_is_another_cell_and_a_comment_is_not(
    text: str, is_same: bool, folder: Path
) -> None:
    suite = suite_text('"file:own/arm.xml"')
    before = [identity(cell) for cell in planned(folder, suite).cells]
    (folder / "own" / "arm.xml").write_text(text)
    after = [identity(cell) for cell in planned(folder, suite).cells]
    assert (before == after) == is_same
    assert is_same or all(
        a != b for one, other in zip(before, after, strict=True)
        for a, b in zip(one, other, strict=True)
    )  # fmt: skip


def test_a_named_robot_keeps_its_seeds_and_has_its_model_in_its_ids(folder: Path) -> None:
    (robot, *_) = planned(folder, suite_text('"ur5"')).cells
    assert robot.spec.content is None
    assert robot.spec.model is not None
    (free, *_) = planned(folder, suite_text('"ur5"', more="free_base = true")).cells
    assert free.spec.model != robot.spec.model


def test_two_files_of_one_name_are_two_robots(folder: Path) -> None:
    (folder / "other").mkdir()
    (folder / "other" / "arm.xml").write_text(HEAVY)
    (folder / "own" / "ur5.xml").write_text(ARM)
    text = suite_text('["file:own/arm.xml", "file:other/arm.xml", "ur5", "file:own/ur5.xml"]')
    plan = planned(folder, text)
    labels = list(dict.fromkeys(cell.labels["robot"] for cell in plan.cells))
    # The third file is the first one, under the name of another robot: its cells are the same.
    assert labels == ["file:own/arm.xml", "file:other/arm.xml", "ur5"]
    assert len(plan.models) == 3
    (folder / "own" / "ur5.xml").write_text(ARM.replace("1.5", "1.6"))
    labels = [cell.labels["robot"] for cell in planned(folder, text).cells]
    assert list(dict.fromkeys(labels))[2:] == ["ur5", "file:own/ur5.xml"]


def test_a_taken_name_with_another_content_is_refused(folder: Path) -> None:
    robots = folder / "robots"
    shutil.copytree(package_folder("robots") / "scara", robots / "scara")
    text = suite_text('"scara"')
    same = planned(folder, text, robots).cells  # a copy is the same robot
    assert [cell.id for cell in same] == [cell.id for cell in planned(folder, text).cells]
    file = robots / "scara" / "robot.toml"
    file.write_text(file.read_text() + "\n# a comment\n")
    planned(folder, text, robots)
    (model,) = (path for path in (robots / "scara").iterdir() if path.suffix in (".xml", ".urdf"))
    model.write_text(changed_mass(model.read_text()))
    with pytest.raises(SysidBenchError, match="'scara' as an installed robot") as error:
        planned(folder, text, robots)
    assert "another name" in str(error.value)
    file.write_text(file.read_text().replace('"scara"', '"my_scara"', 1))
    mine = text.replace('"scara"', '"file:robots/scara"')
    assert planned(folder, mine).cells[0].labels["robot"] == "my_scara"


def changed_mass(text: str) -> str:
    before, mass, after = text.partition('mass="')
    number, quote, rest = after.partition('"')
    if not quote:
        before, mass, after = text.partition('<mass value="')
        number, quote, rest = after.partition('"')
    return f"{before}{mass}{float(number) * 1.1}{quote}{rest}"


@pytest.fixture
def motions(folder: Path) -> Callable[[str], None]:
    """Writes the motion file m.csv, of a slow sine of the two joints."""

    def write(factor: str) -> None:
        lines = ["t,j1,j2", *(f"{k * 0.02},{k % 7 * 0.01},{k % 5}e-{factor}" for k in range(50))]
        (folder / "m.csv").write_text("\n".join(lines))

    return write


def test_a_motion_file_counts_by_its_content(folder: Path, motions: Callable[[str], None]) -> None:
    def identities(path: str) -> list[tuple[object, ...]]:
        motion = f'{{ use = "file", file = "{path}", limits = "mark" }}'
        return [identity(c) for c in planned(folder, suite_text('"ur5"', motion)).cells]

    motions("3")
    first = identities("m.csv")
    (folder / "own" / "copy.csv").write_bytes((folder / "m.csv").read_bytes())
    assert identities("./m.csv") == first == identities("own/copy.csv")
    motions("2")
    other = identities("m.csv")
    assert {one[0] for one in other}.isdisjoint(one[0] for one in first)
    assert other[0][2] != first[0][2]  # noise
    (folder / "m.csv").unlink()
    assert identities("m.csv")  # its cells say that it is absent


LOG = """file = "{}"
rate = "50 Hz"
joints = ["j1", "j2"]
q = {{ columns = [1, 2] }}
tau = {{ columns = [3, 4] }}
"""
RECORDED = """schema = 1
name = "recorded"
[[log]]
name = "run"
robot = "file:own/arm.xml"
train = ["{}"]
test = ["{}"]
[[estimator]]
use = "ols"
"""


def test_recordings_count_by_their_content(folder: Path) -> None:
    def ids(train: str, test: str = "run.toml") -> list[str]:
        return [cell.id for cell in planned(folder, RECORDED.format(train, test)).cells]

    (folder / "data.csv").write_text("1,2,3,4\n" * 9)
    (folder / "run.toml").write_text(LOG.format("data.csv"))
    first = ids("run.toml")
    (folder / "run.toml").write_text(f"# a comment\n{LOG.format('./data.csv')}")
    assert ids("./run.toml", "own/../run.toml") == first
    (folder / "run.toml").write_text(LOG.format("data.csv").replace("50 Hz", "51 Hz"))
    assert ids("run.toml") != first
    (folder / "run.toml").write_text(LOG.format("data.csv"))
    assert ids("run.toml") == first
    (folder / "data.csv").write_text("1,2,3,5\n" * 9)
    assert ids("run.toml") != first
    (folder / "data.csv").unlink()
    assert ids("run.toml") != first


def test_a_file_in_place_of_that_of_a_description_counts_by_itself(folder: Path) -> None:
    def ids() -> list[str]:
        test = '{ use = "run.toml", file = "later.csv", name = "later" }'
        text = RECORDED.replace('["{}"]\ntest = ["{}"]', f'["run.toml"]\ntest = [{test}]')
        return [cell.id for cell in planned(folder, text).cells]

    (folder / "run.toml").write_text(LOG.format("data.csv"))
    seen = set()
    for train, test in (("1", "1"), ("2", "1"), ("1", "2"), ("2", "2")):
        (folder / "data.csv").write_text(f"1,2,3,{train}\n" * 9)
        (folder / "later.csv").write_text(f"1,2,3,{test}\n" * 9)
        seen |= {*ids()}
    assert len(seen) == 4


def test_a_data_set_counts_before_it_is_fetched(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = RECORDED.replace("file:own/arm.xml", "dataset:ur10").replace('test = ["{}"]\n', "")
    found = []
    for place in (folder / "nowhere", folder):
        monkeypatch.setenv("SYSID_BENCH_DATA", str(place))
        found.append(planned(folder, text.format("dataset:ur10/first")).cells[0].spec)
    assert found[0].data is not None
    assert found[0].id == found[1].id


def test_a_gate_matches_cells_by_their_labels(folder: Path) -> None:
    """A model that changed has other ids; the gate names the joint and compares the cells."""
    names, text = default_names(), suite_text('"file:own/arm.xml"')
    runs = []
    for number, model in enumerate((ARM, HEAVY)):
        (folder / "own" / "arm.xml").write_text(model)
        suite = parse_suite(text, "s.toml", folder, names)
        run(suite, folder / f"run{number}", jobs=1, names=names)
        runs.append(read_run(RunFolder(folder / f"run{number}")))
    assert runs[0].cells.keys().isdisjoint(runs[1].cells)
    known = from_text(to_text(baseline_of(runs[0])), "b.json")
    found = find_difference(known.run, runs[1], known.tolerances)
    assert found.is_failed
    assert not found.vanished
    assert not found.appeared
    assert {change.cell for change in found.cells} <= runs[1].cells.keys()
    assert ("j1", "mass") in {(one.joint, one.quantity) for one in found.models}
    # Another suite has other cells, whatever their labels are.
    (folder / "s.json").write_text(to_text(baseline_of(runs[0])).replace('"content"', '"other"'))
    other = from_text((folder / "s.json").read_text(), "s.json")
    assert len(find_difference(other.run, runs[1], other.tolerances).vanished) == 2
    # The frozen ids of a run are those of the model that it was planned with.
    with pytest.raises(UsageError, match=r"'arm' is another one .*j1"):
        run(folder / "run0", jobs=1, rerun="all")
    (folder / "own" / "arm.xml").write_text(COMMENT)
    assert run(folder / "run0", jobs=1, rerun="all").counts == {"ok": 2}


def test_a_run_of_an_earlier_version_is_read(folder: Path) -> None:
    """Its specifications have no hash, and its ids stay what they are."""
    (cell, *_) = planned(folder, suite_text('"ur5"')).cells
    old = cell.to_json()
    for key in ("model", "content", "data"):
        old["spec"].pop(key, None)
    spec = type(cell.spec).from_json(old["spec"])
    assert spec.id != cell.spec.id
    assert spec.model is None
    line = Plan((Cell(spec, cell.estimator, cell.labels, cell.facts, 1.0),)).to_json_lines()
    assert Plan.from_json_lines(text.encode() for text in line).cells[0].spec == spec


@pytest.mark.long
def test_sites_compare_the_same_robots(folder: Path) -> None:
    from sysid_bench.apps.site.commands.site import _site_run

    versions = []
    for number, model in enumerate((ARM, COMMENT, HEAVY)):
        (folder / "own" / "arm.xml").write_text(model)
        (folder / "s.toml").write_text(suite_text('"file:own/arm.xml"'))
        sysid_bench.run(folder / "s.toml", folder / f"run{number}", jobs=1)
        versions.append(_site_run(RunFolder(folder / f"run{number}"), "r").version)
    assert versions[0] == versions[1] != versions[2]
