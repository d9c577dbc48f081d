"""Law: no third-party method has the truth within reach, changes a row, or is scored otherwise."""

import ctypes
import json
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from typing import Any

import pytest

import sysid_bench
from sysid_bench.apps.site.commands.site import site
from sysid_bench.commands.plan import plan
from sysid_bench.errors import UsageError
from sysid_bench.experiments.blind_data import SecretError, method_data
from sysid_bench.experiments.execute import load_experiment, prepare
from sysid_bench.experiments.spec import SEEDS
from sysid_bench.harness.plan import Plan, cells_of_suite
from sysid_bench.harness.run import job_of, run
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.load_suite import load_suite, parse_suite
from sysid_bench.harness.suite.names import default_names
from sysid_bench.harness.work import blind_process
from sysid_bench.harness.work.confinement import ISOLATION
from sysid_bench.words import MACHINE_FIELDS

from . import cheats
from .code_mutations import HOOK
from .runners import suite_of

FILE = Path(cheats.__file__)
IN_MEMORY = ("Heap", "Frames", "References")
OF_PROCESSES = ("Memory", "VirtualMemory", "OtherEnvironments", "Descriptors", "Trace")
OF_FILES = (
    "SeedFile", "Rows", "WritesRows", "Links", "Network", "Socket", "SharedMemory", "Terminal",
    "WritesPackage",
)  # fmt: skip
OF_SYSTEM = ("Cached", "Devices", "Kernel", "Keys", "Keys 2", "Nested")
OWN = (
    "Environment", "Scorer", "Serializers", "Clock", "Preload", "Preload 2", "Processes", "Late",
)  # fmt: skip
CHEATS = (*IN_MEMORY, *OF_PROCESSES, *OF_FILES, *OF_SYSTEM, *OWN)
SECRET = "0123456789abcdef" * 4
SEAL = "a8ae6e6ee929abea3afcfc5258c8ccd6f85273e0d4626d26c7279f3250f77c8e"

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="namespaces are Linux's")


@pytest.fixture
def port(tmp_path: Path) -> Iterator[int]:
    """Resources of others: a port, a socket in a file, shared memory, a terminal and a keyring."""
    ctypes.CDLL(None).syscall({"x86_64": 250}.get(os.uname().machine, 219), 1, None)
    shared = SharedMemory(create=True, size=8)
    terminal = os.openpty()
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        socket.create_server(str(tmp_path / "socket"), family=socket.AF_UNIX),
    ):
        yield server.getsockname()[1]
    shared.unlink()
    for descriptor in terminal:
        os.close(descriptor)


def sealed_plant(folder: Path) -> Path:
    """Write a sealed plant and its seed; return the file of the seed."""
    (folder / "sealed.toml").write_text(f'schema = 1\nsealed = "{SEAL}"\neffects = []\n')
    (folder / "seeds.txt").write_text(f"{SECRET}\n")
    return folder / "seeds.txt"


def rows_with(
    folder: Path, names: tuple[str, ...], port: int, plant: str = '"matched"'
) -> dict[str, dict[str, Any]]:
    """Rows of `ols`, the cheats and an honest method on one experiment, by label."""
    folder.mkdir(exist_ok=True)
    seeds, out = sealed_plant(folder), folder / "run"
    methods = ['use = "ols"']
    for name in (*names, "Honest"):
        own = 1 if name.endswith(" 2") else port
        methods += [
            f'use = "file:{FILE}:{name.partition(" ")[0]}"\nlabel = "{name}"\nrun = "{out}"\n'
            f'seeds = "{seeds}"\nport = {own}'
        ]
    text = suite_of(methods, f'noise = {{ tau = "1 %" }}\nplant = {plant}')
    stored = run(parse_suite(text, folder=folder), out, jobs=1).folder.rows()
    assert stored.garbled == ()
    return {row["estimator"]: row for row in stored.rows.values()}


def scores(row: dict[str, Any]) -> str:
    """A row without its names, times and the word of a cheat on itself."""
    left_out = MACHINE_FIELDS | {"id", "estimator", "fingerprint", "stats", "sources"}
    return json.dumps({k: v for k, v in row.items() if k not in left_out})


@pytest.mark.parametrize(
    "plant", ['"matched"', pytest.param('"file:sealed.toml"', marks=pytest.mark.long)]
)
def test_no_cheat_reaches_anything(
    tmp_path: Path, port: int, plant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(SEEDS, str(tmp_path / "seeds.txt"))
    found = rows_with(tmp_path, CHEATS, port, plant)
    if {found[name].get("isolation") for name in CHEATS} == {"process"}:
        pytest.skip("this system refuses namespaces")
    assert {row["status"] for row in found.values()} == {"ok"}
    assert {name: found[name]["stats"]["reached"] for name in CHEATS} == dict.fromkeys(CHEATS, 0.0)
    assert {scores(found[name]) for name in CHEATS} == {scores(found["Honest"])}
    assert all(0.0 < found[name]["seconds"] < 60.0 for name in CHEATS)
    assert found["Honest"]["torque_error"] == pytest.approx(found["ols"]["torque_error"], rel=1e-6)
    if "sealed" in plant:
        assert all(one["true"] is None for row in found.values() for one in row["parameters_table"])


@pytest.mark.long
def test_no_cheat_of_a_submission_reaches_anything(tmp_path: Path, port: int) -> None:
    """Run again by a reviewer: a word of a cheat that differs would be another value of its row."""
    rows_with(tmp_path, CHEATS, port)
    check = site(submissions=[tmp_path / "run"], seed=1, share=1.0, jobs=2).checks[0]
    assert check.ok, check.summary()
    assert len(check.cells) == len(CHEATS) + 2


def test_methods_of_two_cells_share_no_folder(tmp_path: Path) -> None:
    """Data of another repeat would make an average out of one cell."""
    assert neighbours(tmp_path) == [0.0, 0.0]


def neighbours(folder: Path) -> list[float]:
    """What two methods that run at the same time say of each other's data."""
    text = suite_of([f'use = "file:{FILE}:Neighbour"'], 'noise = { tau = "1 %" }')
    text = text.replace("[defaults]", "[run]\nrepeats = 2\n[defaults]")
    rows = run(parse_suite(text, folder=folder), folder / "run", jobs=2).folder.rows().rows
    return [row["stats"]["reached"] for row in rows.values()]


def test_without_namespaces_cheats_reach_files_and_the_network(
    tmp_path: Path, port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the namespaces hold; and that the tests above look where something is."""
    monkeypatch.setenv(SEEDS, str(tmp_path / "seeds.txt"))
    monkeypatch.setenv(ISOLATION, "process")
    names = (*OF_FILES, *IN_MEMORY)
    found = rows_with(tmp_path, names, port)
    reached = {name for name in names if found[name]["stats"]["reached"]}
    assert reached == set(OF_FILES)
    assert {found[name]["isolation"] for name in names} == {"process"}


def test_a_system_that_refuses_a_part_of_the_namespaces(tmp_path: Path) -> None:
    """Its methods run without, and can start programs as before."""
    code = f"""if True:
        import subprocess
        from sysid_bench.harness.work import confinement

        def refuse(*_):
            raise OSError(1, "mount")

        confinement._mount = refuse
        print(confinement.confine({str(tmp_path)!r}, ["/etc"]))
        for _ in range(2):
            print(subprocess.run(["echo", "started"], capture_output=True, text=True).stdout)
        """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["process", "started", "started"]


def test_time_counts_wherever_and_whenever_it_was_used(tmp_path: Path, port: int) -> None:
    found = rows_with(tmp_path, ("Child", "Ignored", "Early"), port)
    assert 0.9 < found["Child"]["seconds_cpu"] < 5.0
    assert 0.9 < found["Ignored"]["seconds_cpu"] < 5.0
    assert 0.4 < found["Early"]["seconds_cpu"] < 5.0
    assert found["Early"]["seconds"] > 0.4
    assert found["Honest"]["seconds_cpu"] < 0.2


def test_forged_answers_cost_their_own_cell(tmp_path: Path, port: int) -> None:
    found = rows_with(tmp_path, ("ForgesAnswers",), port)
    assert {found[name]["status"] for name in ("ols", "Honest")} == {"ok"}
    assert scores(found["ForgesAnswers"]) == scores(found["Honest"])


def test_a_sealed_plant_needs_namespaces(
    tmp_path: Path, port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(SEEDS, str(tmp_path / "seeds.txt"))
    monkeypatch.setenv(ISOLATION, "process")
    found = rows_with(tmp_path, ("SeedFile", "ForgesAnswers"), port, '"file:sealed.toml"')
    assert found["ols"]["status"] == "ok"
    for name in ("SeedFile", "ForgesAnswers"):
        assert found[name]["status"] == "failed"
        assert "namespaces" in found[name]["reason"]
    monkeypatch.setenv(ISOLATION, "bogus")
    with pytest.raises(UsageError, match="'bogus'; give namespaces or process"):
        rows_with(tmp_path / "again", (), port)


def test_in_the_process_of_the_truth_cheats_reach_it(tmp_path: Path) -> None:
    prepared = _prepared()
    for name in IN_MEMORY:
        assert getattr(cheats, name)().solve(prepared.problem).stats["reached"] == 1.0


def test_data_that_lead_to_the_truth_cannot_be_sent() -> None:
    """A guard of the guard: an object with the truth in a function of a problem is an error."""
    from functools import partial

    prepared = _prepared()
    for secret in (prepared.source.truth, prepared, prepared.source, prepared.robot):
        problem = replace(prepared.problem, blocks=partial(lambda x: x, secret))
        with pytest.raises((SecretError, AttributeError)) as error:
            method_data(problem, None, simulated=True)
        assert "lead to" in str(error.value) or "lambda" in str(error.value)


def _prepared() -> Any:
    suite = parse_suite(suite_of(['use = "ols"']), folder=Path())
    (cell,) = cells_of_suite(suite).cells
    return prepare(*load_experiment(job_of([cell], suite, None)))


# --- Builds without one of the guards -----------------------------------------------------------

CONFINE, PROCESS, EXECUTE = (
    "harness/work/confinement",
    "harness/work/blind_process",
    "experiments/execute",
)
NO_SETTING = "add=_ATTRIBUTE_READ_ONLY | _ATTRIBUTE_NO_DEVICES"
GUARDS: dict[str, tuple[str, dict[str, str], tuple[str, ...]]] = {
    "network": (CONFINE, {" | _NEW_NETWORK |": " |"}, ("Network",)),
    "messages": (CONFINE, {"for path in (_SHARED,)": "for path in ()"}, ("SharedMemory",)),
    "hidden": (CONFINE, {"for path in hidden:": "for path in ():"},
               ("SeedFile", "Rows", "Links", "Socket")),
    "read-only": (CONFINE, {NO_SETTING: "add=_ATTRIBUTE_NO_DEVICES"}, ("WritesPackage", "Nested")),
    "devices": (CONFINE, {NO_SETTING: "add=_ATTRIBUTE_READ_ONLY"}, ("Devices", "Nested")),
    "settings of the kernel": (CONFINE, {" | _READ_ONLY)": ")"}, ("Kernel", "Nested")),
    "keys": (CONFINE, {"    _leave_keyring(libc)\n": ""}, ("Keys 2",)),
    "page cache": (CONFINE, {"    _hide_page_cache(libc)\n": ""}, ("Cached",)),
    "environment": (
        PROCESS,
        {"env=method_environment(folder)": "env={**os.environ, 'TMPDIR': folder}"},
        ("Environment",),
    ),
    # Root is kept out by the capabilities of the other process as well.
    "memory": (CONFINE, {"0 if hidden else 1": "1", "    _drop_capabilities(libc)\n": ""},
               OF_PROCESSES),
    "a process of its own": (EXECUTE, {'self.entry["cell"] not in code["methods"]': "True"},
                             ("Heap", "Frames", "References", "Preload 2")),
}  # fmt: skip
"""File, what is taken out, what stands there instead, and the cheats that then win. A terminal is
kept out twice: its folder is hidden, and so are its devices."""
OF_ROOT = ("Devices", "Kernel", "Nested")
"""What only root may open, so that only methods that run as root need the guard."""


def without_guard(
    name: str, changes: dict[str, str], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Let the processes that are started from now on read a module with other lines."""
    file = Path(sysid_bench.__file__).parent / f"{name}.py"
    text = file.read_text()
    for old, new in changes.items():
        assert text.count(old) == 1, (name, old)
        text = text.replace(old, new)
    hook = HOOK.format(text=text.encode(), file=str(file))
    (folder / "hook").mkdir()
    (folder / "hook" / "sitecustomize.py").write_text(hook)
    monkeypatch.setenv("PYTHONPATH", f"{folder / 'hook'}{os.pathsep}{Path(__file__).parents[2]}")


@pytest.mark.long
@pytest.mark.parametrize("guard", GUARDS)
def test_a_cheat_wins_without_its_guard(
    guard: str, tmp_path: Path, port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each guard is needed, and each cheat looks where something is."""
    file, changes, names = GUARDS[guard]
    without_guard(file, changes, tmp_path, monkeypatch)
    if file != EXECUTE:  # beside seeds no method runs in the process of its scores
        monkeypatch.setenv(SEEDS, str(tmp_path / "seeds.txt"))
    if guard == "memory":  # in namespaces there is no other process
        monkeypatch.setenv(ISOLATION, "process")
        restricted = Path("/proc/sys/kernel/yama/ptrace_scope")
        if restricted.exists() and restricted.read_text().strip() != "0":
            pytest.skip("this system lets processes trace their children alone")
    tried = tuple(dict.fromkeys([*(n.removesuffix(" 2") for n in names), *names]))
    found = rows_with(tmp_path, tried, port)
    expected = {name for name in names if os.getuid() == 0 or name not in OF_ROOT}
    reasons = [row["reason"] for row in found.values()]
    assert {row["status"] for row in found.values()} == {"ok"}, reasons
    assert {name for name in names if found[name]["stats"]["reached"]} == expected


@pytest.mark.long
def test_a_late_thread_spoils_other_cells_in_their_process(
    tmp_path: Path, port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    honest = rows_with(tmp_path / "with", ("Late",), port)["Honest"]
    _, changes, _ = GUARDS["a process of its own"]
    without_guard(EXECUTE, changes, tmp_path, monkeypatch)
    spoilt = rows_with(tmp_path / "without", ("Late",), port)["Honest"]
    assert honest["torque_error"] < 0.1
    assert spoilt["torque_error"] == 99.0


@pytest.mark.long
def test_time_of_children_is_lost_where_a_method_may_ignore_them(
    tmp_path: Path, port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_guard(CONFINE, {"    _count_all_children(libc)\n": ""}, tmp_path, monkeypatch)
    assert rows_with(tmp_path, ("Ignored",), port)["Ignored"]["seconds_cpu"] < 0.5


@pytest.mark.long
def test_in_a_folder_on_the_disk_methods_see_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_guard(CONFINE, {"    if private:\n": "    if False:\n"}, tmp_path, monkeypatch)
    assert neighbours(tmp_path) == [1.0, 1.0]


def test_what_a_method_writes_without_end_does_not_fill_its_caller() -> None:
    """Nor does it keep the caller from ending."""
    code = "import sys\nwhile True: sys.stdout.write('{\"x\": \"' + 'x' * 10**6 + '\"}\\n')"
    with subprocess.Popen([sys.executable, "-c", code], stdin=-1, stdout=-1) as process:
        method = blind_process.BlindMethod(process, simulated=True)
        time.sleep(0.5)
        assert method._inbox.qsize() <= 2
        process.kill()
        process.wait()
        method.end()
        assert not method._listener.is_alive()


# --- Code that runs before any cell -------------------------------------------------------------

HOOKS = '''
import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sysid_bench.types import Estimate


def look():
    """End this import or construction where a secret is in reach."""
    reached = ["environment"] if any("SEEDS" in name for name in os.environ) else []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if b"SYSID_BENCH_SEEDS=" in (process / "environ").read_bytes():
                reached.append("another environment")
        except OSError:
            pass
    try:
        reached += ["seeds"] if Path(SEEDS).read_text() else []
    except OSError:
        pass
    if reached:
        raise SystemExit("reached " + ", ".join(reached))


class Base:
    def __init_subclass__(cls):
        HOOK == "subclass" and look()

    def solve(self, problem):
        look()
        return Estimate(np.linalg.lstsq(problem.W, problem.b, rcond=None)[0])


class Signature:
    def __get__(self, *_):
        HOOK == "signature" and look()


class Method(Base):
    def __init__(self):
        HOOK == "constructor" and look()

    if HOOK == "signature":
        __signature__ = Signature()


HOOK == "import" and look()
'''
PLACES = ("import", "subclass", "signature", "constructor")


def suite_of_hooks(folder: Path, plant: str = '"file:sealed.toml"') -> str:
    """A suite whose methods look for the secret where their code runs first."""
    seeds = sealed_plant(folder)
    for place in PLACES:
        head = f"SEEDS, HOOK = {str(seeds)!r}, {place!r}\n"
        (folder / f"{place}.py").write_text(head + HOOKS)
    methods = [f'use = "file:{place}.py:Method"\nlabel = "{place}"' for place in PLACES]
    return suite_of(methods, f"plant = {plant}")


@pytest.mark.parametrize("plant", ['"file:sealed.toml"', '"matched"'])
def test_code_that_runs_before_any_cell_reaches_no_secret(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plant: str
) -> None:
    (tmp_path / "suite.toml").write_text(suite_of_hooks(tmp_path, plant))
    monkeypatch.setenv(SEEDS, str(tmp_path / "seeds.txt"))
    rows = run(str(tmp_path / "suite.toml"), tmp_path / "run", jobs=1).folder.rows().rows.values()
    assert len(rows) == len(PLACES)
    assert not [row["reason"] for row in rows if "reached" in row["reason"]]
    assert {row["status"] for row in rows} == {"ok"}
    # Read in the caller's process, the suite runs no code at all.
    before = len(sys.modules)
    parse_suite((tmp_path / "suite.toml").read_text(), folder=tmp_path)
    assert len(sys.modules) == before


def test_without_its_confinement_planning_gives_the_secret_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = suite_of_hooks(tmp_path)
    monkeypatch.setenv(SEEDS, str(tmp_path / "seeds.txt"))
    with pytest.raises(UsageError) as error:
        parse_suite(text, folder=tmp_path, names=default_names())
    # Processes of other tests may have the secret in their environment, too.
    reached = re.findall("reached environment,(?: another environment,)* seeds", str(error.value))
    assert len(reached) == len(PLACES)


def test_without_namespaces_planning_runs_no_code_beside_seeds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "suite.toml").write_text(suite_of_hooks(tmp_path))
    monkeypatch.setenv(ISOLATION, "process")
    monkeypatch.setenv(SEEDS, str(tmp_path / "seeds.txt"))
    assert len(plan(tmp_path / "suite.toml").cells) == len(PLACES)


def test_beside_seeds_no_other_code_of_others_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Metrics and effects see the truth, and other verbs run a plug-in as the user does."""
    metric = "from sysid_bench.types import Metric\n\n\ndef own(cell):\n    return 0.0\n\n\n"
    metric += 'Own = Metric("own", "Own", compute=own)\n'
    (tmp_path / "metric.py").write_text(metric)
    more = '[[metric]]\nuse = "file:metric.py:Own"\n'
    (tmp_path / "suite.toml").write_text(suite_of_hooks(tmp_path) + more)
    monkeypatch.setenv(SEEDS, str(tmp_path / "seeds.txt"))
    rows = run(str(tmp_path / "suite.toml"), tmp_path / "run", jobs=1).folder.rows().rows.values()
    assert {row["status"] for row in rows} == {"failed"}
    assert all("unset SYSID_BENCH_SEEDS" in row["reason"] for row in rows)
    words = ["check-plugin", f"file:{tmp_path}/import.py:Method", "--kind", "estimator"]
    done = subprocess.run(
        [sys.executable, "-m", "sysid_bench", *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "unset SYSID_BENCH_SEEDS" in done.stderr


def test_a_plan_that_names_more_than_its_suite_runs_it_blind(tmp_path: Path) -> None:
    """A run folder of somebody else: its plan has a method that its suite does not have."""
    (tmp_path / "suite.toml").write_text(suite_of(['use = "ols"']))
    suite = load_suite(tmp_path / "suite.toml")
    cells = cells_of_suite(suite).cells
    hidden = replace(cells[0], estimator={"use": f"file:{FILE}:Heap"})
    RunFolder.new(tmp_path / "run", suite, Plan((hidden,)), {})
    (row,) = run(str(tmp_path / "run"), jobs=1).folder.rows().rows.values()
    assert row["stats"]["reached"] == 0.0
    assert row["isolation"] is not None


def test_files_of_the_working_folder_replace_no_library(tmp_path: Path) -> None:
    """A reviewer works in the folder of a submission."""
    for name in ("numpy", "sysid_bench", "json", "sitecustomize", "usercustomize", "conftest"):
        (tmp_path / f"{name}.py").write_text('open("ran", "a").write(__name__)\n1 / 0\n')
    (tmp_path / "own.pth").write_text('import os; open("ran", "a").write("pth")\n')
    (tmp_path / "mine.py").write_text("from tests.faults.cheats import Honest\n")
    (tmp_path / "suite.toml").write_text(suite_of(['use = "ols"', 'use = "mine:Honest"']))
    command = [str(Path(sys.executable).with_name("sysid-bench")), "run", "suite.toml", "-o", "run"]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "ran").exists()
