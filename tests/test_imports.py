"""Imports and calls of the whole package, read from the syntax."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from tests.syntax import FILES, ROOT, nodes

HEAVY = {
    "matplotlib": "figures alone need it, 0.4 s",
    "rerun": "recordings alone need it, 0.6 s",
    "pandas": "tables alone need it, 0.5 s",
    "pyarrow": "parquet files alone need it",
    "requests": "downloads alone need it, 0.1 s",
    "rich": "progress on a terminal alone needs it",
    "jinja2": "the HTML report alone needs it",
    "markupsafe": "the HTML report alone needs it",
    "clarabel": "solver of feasible fits, absent on some platforms",
    "cvxpy": "optional, compared with in tests",
    "robot_descriptions": "optional source of models",
    "scipy": "sub-packages take up to 0.3 s, and few cells need them",
}
"""Libraries that one use needs and every start would wait for."""

COMMANDS = ("commands/", "apps/site/commands/", "apps/surveys/commands/", "apps/twins/commands/")
START = ("__init__.py", *COMMANDS, "pytest_plugin.py")
"""Files on the way of `import sysid_bench` and --help; see test_startup.py."""

EXCEPTIONS = {
    (
        "apps/actuators/task.py",
        "sysid_bench.apps.actuators.drive_experiment",
    ): "loads SciPy and the simulation, which a list of tasks does without",
    ("errors.py", "difflib"): "1.5 ms at each start, for errors alone",
    ("harness/fingerprint.py", "sysid_bench.experiments.recorded.prepare"): "loads MuJoCo",
    ("harness/suite/names.py", "sysid_bench.models.load"): "only robots with sensors are loaded",
    ("harness/suite/names.py", "sysid_bench.models.sensor"): "loads MuJoCo",
    (
        "harness/suite/names.py",
        "sysid_bench.signals.log_content",
    ): "suites without files do without",
    ("harness/suite/names.py", "sysid_bench.experiments.tasks.task"): "loads MuJoCo",
    ("models/model_record.py", "sysid_bench.models.behaviour"): "loads MuJoCo",
    (
        "models/robot.py",
        "sysid_bench.models.pairing",
    ): "Pinocchio takes 0.2 s to load, and most commands need MuJoCo alone",
    **dict.fromkeys(
        (
            ("harness/work/blind_worker.py", module)
            for module in (
                "resource",
                "types",
                "sysid_bench.canonical_json",
                "sysid_bench.errors",
                "sysid_bench.experiments.blind_data",
                "sysid_bench.harness.work.confinement",
                "sysid_bench.identification.identify",
                "sysid_bench.plugin_names",
                "sysid_bench.words",
            )
        ),
        "libraries are loaded in the confined process alone: they start threads and take memory",
    ),
    ("harness/work/row_files.py", "pydantic_core"): "workers, which write alone, do without it",
    ("commands/record.py", "sysid_bench.experiments.cell_data"): "loads MuJoCo",
    ("commands/record.py", "sysid_bench.reporting"): "its cell_recording loads rerun",
    ("package_folders.py", "importlib.metadata"): "16 ms that completion would wait for",
    ("version_fields.py", "numpy"): "versions are read where no array is needed",
}
"""(file, module) of every other import within a function, with its reason."""

MOST_LOCAL = 60
MOST_POSITIONAL = 6

FOREIGN = {
    *("itertools.product", "library.simulation_steps", "library.laws_along", "mujoco.mj_applyFT")
}
"""Functions of other libraries, and of C, that take positional arguments alone."""


@cache
def local_imports(file: Path) -> tuple[str, ...]:
    """Modules imported within functions of a file."""
    functions = [
        range(node.lineno, (node.end_lineno or node.lineno) + 1)
        for node in nodes(file)
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
    ]
    return tuple(
        module
        for node in nodes(file)
        if isinstance(node, (ast.Import, ast.ImportFrom))
        if any(node.lineno in lines for lines in functions)
        for module in modules_of(node)
    )


def modules_of(node: ast.Import | ast.ImportFrom) -> list[str]:
    """Modules that a statement imports."""
    if isinstance(node, ast.ImportFrom):
        return ["." * node.level + (node.module or "")]
    return [alias.name for alias in node.names]


def positional_calls(file: Path) -> Iterator[str]:
    """Calls of a file with too many positional arguments, as "line: function (count)"."""
    for node in nodes(file):
        if isinstance(node, ast.Call) and len(node.args) > MOST_POSITIONAL:
            name = ast.unparse(node.func)
            if name not in FOREIGN:
                yield f"{node.lineno}: {name} ({len(node.args)})"


def short(file: Path) -> str:
    return file.relative_to(ROOT).as_posix()


def test_imports_within_functions_have_a_reason() -> None:
    unexplained = [
        f"{name}: {module}"
        for file in FILES
        if not (name := short(file)).startswith(START)
        for module in local_imports(file)
        if module.partition(".")[0] not in HEAVY and (name, module) not in EXCEPTIONS
    ]
    assert not unexplained, f"Move to the top of the file, or give a reason: {unexplained}"


def test_every_exception_is_needed() -> None:
    found = {(short(file), module) for file in FILES for module in local_imports(file)}
    assert set(EXCEPTIONS) <= found, f"no longer there: {set(EXCEPTIONS) - found}"


def test_imports_within_functions_are_few() -> None:
    others = (file for file in FILES if not short(file).startswith(COMMANDS))
    assert sum(1 for file in others for _ in local_imports(file)) <= MOST_LOCAL


def test_long_calls_name_their_arguments() -> None:
    long = [f"{short(file)}:{call}" for file in FILES for call in positional_calls(file)]
    assert not long, "\n".join(long)


def test_the_checks_see_what_they_forbid(tmp_path: Path) -> None:
    file = tmp_path / "a.py"
    file.write_text(
        "def f():\n    from json import dumps\n    import csv\nf(1, 2, 3, 4, 5, 6, 7)\n"
    )
    assert sorted(local_imports(file)) == ["csv", "json"]
    assert list(positional_calls(file)) == ["4: f (7)"]
