"""Law: no third-party method has the truth within reach, changes a row, or is scored otherwise."""

import json
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from sysid_bench.errors import UsageError
from sysid_bench.experiments.blind_data import SecretError, method_data
from sysid_bench.experiments.execute import load_experiment, prepare
from sysid_bench.experiments.spec import SEEDS
from sysid_bench.harness.plan import cells_of_suite
from sysid_bench.harness.run import job_of, run
from sysid_bench.harness.suite.load_suite import parse_suite
from sysid_bench.harness.work.blind_process import ISOLATION
from sysid_bench.words import MACHINE_FIELDS

from . import cheats

FILE = Path(cheats.__file__)
IN_MEMORY = ("Heap", "Frames", "References")
OF_PROCESSES = ("Memory", "VirtualMemory", "OtherEnvironments", "Descriptors")
OF_FILES = ("SeedFile", "Rows", "WritesRows", "Links", "Network")
OWN = ("Environment", "Scorer", "Clock", "Preload", "Preload 2")
CHEATS = (*IN_MEMORY, *OF_PROCESSES, *OF_FILES, *OWN)
SECRET = "0123456789abcdef" * 4
SEAL = "a8ae6e6ee929abea3afcfc5258c8ccd6f85273e0d4626d26c7279f3250f77c8e"

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="namespaces are Linux's")


@pytest.fixture
def port() -> Iterator[int]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


def rows_with(
    folder: Path, names: tuple[str, ...], port: int, plant: str = '"matched"'
) -> dict[str, dict[str, Any]]:
    """Rows of `ols`, the cheats and an honest method on one experiment, by label."""
    folder.mkdir(exist_ok=True)
    seeds, out = folder / "seeds.txt", folder / "run"
    seeds.write_text(f"{SECRET}\n")
    (folder / "sealed.toml").write_text(f'schema = 1\nsealed = "{SEAL}"\neffects = []\n')
    text = f"""
        schema = 1
        name = "cheats"
        [defaults]
        excitation = {{ use = "fourier", harmonics = 3, period = "2 s" }}
        held_out = ["ptp"]
        noise = {{ tau = "1 %" }}
        plant = {plant}
        [[robot]]
        use = "scara"
        [[estimator]]
        use = "ols"
        """
    for name in (*names, "Honest"):
        text += f"""
        [[estimator]]
        use = "file:{FILE}:{name.partition(chr(32))[0]}"
        label = "{name}"
        run = "{out}"
        seeds = "{seeds}"
        port = {0 if name == "Preload 2" else port}
        """
    stored = run(parse_suite(text, folder=folder), out, jobs=1).folder.rows()
    assert stored.garbled == ()
    return {row["estimator"]: row for row in stored.rows.values()}


def scores(row: dict[str, Any]) -> str:
    """A row without its names, times and the word of a cheat on itself."""
    left_out = MACHINE_FIELDS | {"id", "estimator", "fingerprint", "stats", "sources"}
    return json.dumps({k: v for k, v in row.items() if k not in left_out})


@pytest.mark.parametrize("plant", ['"matched"', '"file:sealed.toml"'])
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


def test_the_time_of_a_process_that_was_left_counts(tmp_path: Path, port: int) -> None:
    found = rows_with(tmp_path, ("Child",), port)
    assert 0.9 < found["Child"]["seconds_cpu"] < 5.0


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
    from dataclasses import replace
    from functools import partial

    prepared = _prepared()
    for secret in (prepared.source.truth, prepared, prepared.source, prepared.robot):
        problem = replace(prepared.problem, blocks=partial(lambda x: x, secret))
        with pytest.raises((SecretError, AttributeError)) as error:
            method_data(problem, None, simulated=True)
        assert "lead to" in str(error.value) or "lambda" in str(error.value)


def _prepared() -> Any:
    suite = parse_suite(
        'schema = 1\nname = "one"\n[defaults]\nexcitation = "ptp"\nheld_out = ["ptp"]\n'
        '[[robot]]\nuse = "scara"\n[[estimator]]\nuse = "ols"\n',
        folder=Path(),
    )
    (cell,) = cells_of_suite(suite).cells
    return prepare(*load_experiment(job_of([cell], suite, None)))
