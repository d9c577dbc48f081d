"""Who may import whom: the map of the packages, packages of one layer and four rules.

Imports are read from the syntax, also inside functions, under TYPE_CHECKING and by the name in
`import_module`; other names in strings (entry points) are ways to receive an object, and are left
alone.
"""

import ast
import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from tests.syntax import FILES, ROOT, nodes

PACKAGE = "sysid_bench"

BASE = frozenset((
    "canonical_json", "csv_text", "errors", "extras", "input_files", "instruction_sets",
    "metrics", "numerics",
    "package_folders", "plugin_names", "spatial", "types", "units", "version_fields", "words",
))  # fmt: skip
TOP = frozenset((
    "__init__", "__main__", "apps", "commands", "pytest_cells", "pytest_plugin", "pytest_suite",
    "reference",
))  # fmt: skip
BELOW_EVALUATION = frozenset((
    "excitation", "identifiability", "identification", "models", "regressors", "signals",
    "simulation",
))  # fmt: skip
CORE_BELOW_HARNESS = BELOW_EVALUATION | {"evaluation", "experiments"}
# package -> the packages it may import besides itself and the base. An application may import the
# core, and no other application; the core imports none.
MAP: dict[str, frozenset[str]] = {
    **dict.fromkeys(BASE, frozenset()),
    "models": frozenset(),
    "regressors": frozenset({"models"}),
    "identifiability": frozenset({"models", "regressors"}),
    "excitation": frozenset({"models", "regressors", "identifiability"}),
    "signals": frozenset({"models", "regressors", "identifiability"}),
    # Not identifiability: it imports the regressors.
    "simulation": frozenset({"models"}),
    "identification": frozenset({"identifiability"}),
    "evaluation": BELOW_EVALUATION,
    # Recordings are judged without any estimator: what is tested on them must not vouch for them.
    "diagnosis": frozenset({"models", "regressors", "signals"}),
    "experiments": BELOW_EVALUATION | {"evaluation"},
    "harness": CORE_BELOW_HARNESS,
    "reporting": BELOW_EVALUATION | {"evaluation"},
    # Conformance of plug-ins is measured with the metrics of evaluation, never the reverse; its kit
    # of executors runs jobs as those of suites.
    "apps.conformance": CORE_BELOW_HARNESS | {"harness"},
    # Executors on other machines, as those of anybody.
    "apps.clusters": frozenset({"harness"}),
    # Pages of results from rows, with the tables and figures of reports.
    "apps.site": frozenset({"evaluation", "reporting"}),
    # Collections and tables of surveys: the models themselves are loaded by the verb, in workers.
    "apps.surveys": frozenset({"models"}),
    # Fits of recordings of position-commanded robots, their simulation under the commands, and
    # the task that brings them into suites.
    "apps.actuators": CORE_BELOW_HARNESS,
    # Estimators that fit simulations with optimisers of other packages.
    "apps.peers": frozenset({"identification"}),
    # Effects fitted from recordings, and replays that both kinds of experiments judge.
    "apps.twins": CORE_BELOW_HARNESS,
}
SIDE_BY_SIDE = (
    frozenset({"excitation", "simulation", "signals", "identification"}),
    frozenset({"harness", "reporting"}),
)
# Inside the harness: a folder -> the folders of the harness it may import besides itself.
HARNESS: dict[str, frozenset[str]] = {
    "suite": frozenset(),
    "work": frozenset(),
    # Runs and baselines are compared by what a run folder stores.
    "comparison": frozenset({"stored_run", "frames"}),
}
# Checks of plug-ins run the kits themselves.
VERBS_OF_KITS = frozenset({"check_plugin.py"})
ENGINES = frozenset({"mujoco", "pinocchio"})
SECRETS = re.compile(r"\b(Oracle|Truth)\b")
SECRET_PACKAGES = frozenset({"types", "models", "simulation", "evaluation", "experiments"})


def package_of(file: Path, root: Path) -> str:
    """The first word below the package: a folder, or a file without its suffix; applications have
    two ("apps.twins"), but for their verbs, which are commands as the others."""
    place = file.relative_to(root).parts
    if place[0] == "apps" and len(place) > 2:
        return "commands" if place[2] == "commands" else f"apps.{place[1]}"
    return place[0].removesuffix(".py")


@cache
def imports(file: Path, root: Path) -> tuple[tuple[int, str], ...]:
    """(line, dotted module) of every import; `from a import b` gives a.b, module or not."""
    return tuple(_imports(file, root))


def _imports(file: Path, root: Path) -> Iterator[tuple[int, str]]:
    package = [PACKAGE, *file.relative_to(root).parts[:-1]]
    for node in nodes(file):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            start = package[: len(package) + 1 - node.level] if node.level else []
            parts = start + ([node.module] if node.module else [])
            yield from ((node.lineno, ".".join([*parts, alias.name])) for alias in node.names)
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            names = [arg.value for arg in node.args if isinstance(arg, ast.Constant)]
            yield from ((node.lineno, name) for name in names if isinstance(name, str))


def packages_imported(file: Path, root: Path) -> Iterator[tuple[int, str]]:
    """(line, package) of every import of ours; sysid_bench itself counts as `__init__`."""
    for line, module in imports(file, root):
        first, _, rest = module.partition(".")
        if first == PACKAGE:
            parts = rest.split(".")
            package = ".".join(parts[:2]) if parts[0] == "apps" else parts[0]
            if parts[0] == "apps" and parts[2:3] == ["commands"]:
                package = "commands"
            if parts[:2] == ["evaluation", "intervals"]:  # imports the base only
                continue
            yield line, package if package in MAP or package in TOP else "__init__"


def off_the_map(file: Path, root: Path) -> list[str]:
    """Imports that the map does not grant, and files that it does not know."""
    package = package_of(file, root)
    if package in TOP:
        return []
    if package not in MAP:
        return [f"{file}: {package!r} is not on the map in {Path(__file__).name}; give it a place."]
    granted = MAP[package] | BASE | {package}
    return [
        f"{file}:{line} imports {other}; {package} may import "
        f"{', '.join(sorted(granted - {package}))}."
        for line, other in packages_imported(file, root)
        if other not in granted
    ]


def core_imports_an_application(file: Path, root: Path) -> list[str]:
    """Verbs of the core and of other applications know an application by the names in tables alone;
    the package itself lists their functions, and its plug-in for pytest is of the kits."""
    place = file.relative_to(root).parts
    home = ".".join((PACKAGE, *place[:2], ""))
    if place[0] not in ("commands", "reference", "apps") or file.name in VERBS_OF_KITS:
        return []
    return [
        f"{file}:{line} imports {module}: name it in a table (commands/table.py, plug-ins, tasks)."
        for line, module in imports(file, root)
        if f"{module}.".startswith(f"{PACKAGE}.apps.") and not f"{module}.".startswith(home)
    ]


def across_one_layer(file: Path, root: Path) -> list[str]:
    """Imports between packages of one layer."""
    package = package_of(file, root)
    neighbours = {
        other for group in SIDE_BY_SIDE if package in group for other in group - {package}
    }
    return [
        f"{file}:{line} imports {other}, which is of the same layer as "
        f"{package}: they meet in a higher layer."
        for line, other in packages_imported(file, root)
        if other in neighbours
    ]


def upwards_in_the_harness(file: Path, root: Path) -> list[str]:
    """Reading a suite, work in processes and one experiment know nothing of plans and runs."""
    place = file.relative_to(root).parts
    if place[0] != "harness" or len(place) < 3:
        return []
    granted = HARNESS[place[1]] | {place[1]}
    inner = f"{PACKAGE}.harness."
    names = ", ".join(sorted(granted))
    return [
        f"{file}:{line} imports {module}; harness/{place[1]} may import {names}."
        for line, module in imports(file, root)
        if module.startswith(inner) and module.removeprefix(inner).partition(".")[0] not in granted
    ]


def plant_sees_the_tested(file: Path, root: Path) -> list[str]:
    """Rule 1: what makes the data never sees what is tested on it."""
    if package_of(file, root) != "simulation":
        return []
    return [
        f"{file}:{line} imports {other}: simulation must not know what is tested on its data."
        for line, other in packages_imported(file, root)
        if other in ("regressors", "identification")
    ]


def reference_imports_kernels(file: Path, root: Path) -> list[str]:
    """Rule 2: the reference regressors import no regressor module but each other."""
    place = file.relative_to(root)
    if place.parts[0] != "regressors" or not place.name.startswith("pinocchio"):
        return []
    ours, reference = f"{PACKAGE}.regressors", f"{PACKAGE}.regressors.pinocchio"
    return [
        f"{file}:{line} imports {module}: the reference must stay independent."
        for line, module in imports(file, root)
        if module.startswith(ours) and not module.startswith(reference)
    ]


def method_holds_an_engine(file: Path, root: Path) -> list[str]:
    """Rule 3: methods get simulators and regressors injected, as functions."""
    if package_of(file, root) != "identification":
        return []
    engines = [(line, module.partition(".")[0]) for line, module in imports(file, root)]
    ours = packages_imported(file, root)
    return [
        f"{file}:{line} imports {other}: identification takes it as a function instead."
        for line, other in [*engines, *ours]
        if other in ENGINES | {"models", "regressors"}
    ]


def truth_is_named(file: Path, root: Path) -> list[str]:
    """Rule 4: the nouns that hold the truth are named only where it is made, given or scored."""
    if package_of(file, root) in SECRET_PACKAGES:
        return []
    return [
        f"{file}:{line} names {name}: only {', '.join(sorted(SECRET_PACKAGES))} may."
        for line, text in identifiers(file)
        for name in SECRETS.findall(text)
    ]


def identifiers(file: Path) -> Iterator[tuple[int, str]]:
    """(line, text) of names, attributes, definitions, arguments, imports, quoted annotations."""
    for node in nodes(file):
        for word in ("id", "attr", "name", "arg", "asname"):
            text = getattr(node, word, None)
            if isinstance(text, str):
                yield getattr(node, "lineno", 0), text
        for word in ("annotation", "returns"):
            if annotation := getattr(node, word, None):
                for part in ast.walk(annotation):
                    if isinstance(part, ast.Constant) and isinstance(part.value, str):
                        yield part.lineno, part.value


Rule = Callable[[Path, Path], list[str]]
RULES: tuple[Rule, ...] = (
    off_the_map,
    core_imports_an_application,
    across_one_layer,
    upwards_in_the_harness,
    plant_sees_the_tested,
    reference_imports_kernels,
    method_holds_an_engine,
    truth_is_named,
)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_every_file_keeps_the_rule(rule: Rule) -> None:
    broken = [line for file in FILES for line in rule(file, ROOT)]
    assert not broken, "\n".join(broken)


def test_the_walk_sees_the_package() -> None:
    assert {"types.py", "plugin_names.py"} <= {file.name for file in FILES}


# --- The checker itself, on trees that are wrong in one place -----------------------------------

BAD = [
    (off_the_map, "models/load.py", "from sysid_bench.regressors import body"),
    (off_the_map, "spatial.py", "def f():\n    import sysid_bench.models.load"),
    (off_the_map, "units.py", "from sysid_bench import models"),
    (off_the_map, "units.py", "import_module('sysid_bench.models')"),
    (off_the_map, "harness/plan.py", "import sysid_bench"),
    (off_the_map, "harness/plan.py", "from sysid_bench import __version__"),
    (off_the_map, "harness/plan.py", "from .. import commands"),
    (off_the_map, "evaluation/crosscheck.py", "from ..harness import plan"),
    (off_the_map, "evaluation/crosscheck.py", "from sysid_bench.apps.conformance import check"),
    (off_the_map, "simulation/inverse.py", "from sysid_bench.identifiability import base"),
    (off_the_map, "reporting/html.py", "from sysid_bench.apps.site import site_pages"),
    (off_the_map, "apps/twins/replay.py", "from sysid_bench.apps.actuators import rollout"),
    (off_the_map, "apps/twins/replay.py", "from ..actuators.rollout import Drives"),
    (off_the_map, "apps/unknown/a.py", ""),
    (off_the_map, "unknown.py", ""),
    (
        core_imports_an_application,
        "commands/identify.py",
        "def f():\n    from sysid_bench.apps.actuators import task",
    ),
    (core_imports_an_application, "commands/lint.py", "from ..apps.surveys import survey"),
    (
        core_imports_an_application,
        "apps/twins/commands/twin.py",
        "from sysid_bench.apps.actuators.task import ActuatorsTask",
    ),
    (
        across_one_layer,
        "excitation/fourier.py",
        "from sysid_bench.signals.noise import White",
    ),
    (across_one_layer, "signals/noise.py", "from ..simulation import inverse"),
    (across_one_layer, "reporting/html.py", "from sysid_bench import harness"),
    (across_one_layer, "harness/run.py", "import sysid_bench.reporting.html as html"),
    (upwards_in_the_harness, "harness/suite/read.py", "from sysid_bench.harness import run"),
    (upwards_in_the_harness, "harness/work/crew.py", "from ..suite.names import Names"),
    (off_the_map, "experiments/execute.py", "from sysid_bench.harness.plan import Cell"),
    (off_the_map, "experiments/execute.py", "from ..apps.actuators import task"),
    (off_the_map, "models/robot.py", "from sysid_bench.experiments.tasks.task import Task"),
    (plant_sees_the_tested, "simulation/inverse.py", "import sysid_bench.regressors.body"),
    (plant_sees_the_tested, "simulation/effects/a.py", "from ...identification import identify"),
    (
        reference_imports_kernels,
        "regressors/pinocchio.py",
        "from sysid_bench.regressors.body import Y",
    ),
    (reference_imports_kernels, "regressors/pinocchio.py", "from . import body"),
    (reference_imports_kernels, "regressors/pinocchio_wrench.py", "from . import wrench"),
    (reference_imports_kernels, "regressors/pinocchio.py", "def f():\n    from .body import Y"),
    (method_holds_an_engine, "identification/estimators/iv.py", "import mujoco.rollout"),
    (method_holds_an_engine, "identification/identify.py", "from pinocchio import rnea"),
    (
        method_holds_an_engine,
        "identification/identify.py",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from ..models import robot",
    ),
    (method_holds_an_engine, "identification/identify.py", "from sysid_bench import regressors"),
    (truth_is_named, "identification/identify.py", "from sysid_bench.types import Oracle"),
    (truth_is_named, "identification/identify.py", "from x import y as Truth"),
    (truth_is_named, "identification/identify.py", "import x\nx.Truth"),
    (truth_is_named, "signals/noise.py", 'def f(peek: "Oracle | None"):\n    pass'),
    (truth_is_named, "regressors/body.py", 'def f() -> "list[Truth]":\n    pass'),
    (truth_is_named, "commands/main.py", "class Oracle:\n    pass"),
]
GOOD = [
    ("errors.py", ""),
    ("plugin_names.py", "import importlib\nimportlib.import_module(path)"),
    ("plugin_names.py", "from sysid_bench.errors import UsageError\nfrom sysid_bench import units"),
    (
        "regressors/pinocchio.py",
        "import pinocchio\nfrom sysid_bench.models.robot import RobotModel",
    ),
    ("regressors/body.py", "from .derive import Y\nfrom . import kernel"),
    ("simulation/inverse.py", "import mujoco\nfrom sysid_bench.types import Oracle, Truth"),
    ("identification/identify.py", '"""Neither Oracle nor Truth."""\nimport numpy'),
    ("reporting/tables.py", "HEAD = 'Truth'\nfrom sysid_bench.evaluation.metrics import rms"),
    ("commands/main.py", "from sysid_bench import harness, reporting\nimport mujoco"),
    ("apps/twins/commands/limits.py", "from sysid_bench.apps.twins import recorded_robot"),
    ("__init__.py", "from sysid_bench.apps.site.commands.site import site"),
    ("__init__.py", "from sysid_bench.harness.run import run"),
]


def write(root: Path, name: str, text: str) -> Path:
    file = root / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text, encoding="utf-8")
    return file


@pytest.mark.parametrize(("rule", "name", "text"), BAD)
def test_a_broken_rule_is_seen_and_named(rule: Rule, name: str, text: str, tmp_path: Path) -> None:
    file = write(tmp_path, name, text)
    said = rule(file, tmp_path)
    assert said
    assert all(line.startswith(str(file)) for line in said)


@pytest.mark.parametrize(("name", "text"), GOOD)
def test_what_is_allowed_is_let_through(name: str, text: str, tmp_path: Path) -> None:
    file = write(tmp_path, name, text)
    assert [line for rule in RULES for line in rule(file, tmp_path)] == []


def test_the_map_grants_nothing_across_a_landing_and_has_no_circle() -> None:
    assert not [r for group in SIDE_BY_SIDE for r in group if MAP[r] & group]
    reach = {package: set(others) for package, others in MAP.items()}
    for _ in MAP:
        reach = {package: seen.union(*(reach[o] for o in seen)) for package, seen in reach.items()}
    assert not [package for package, seen in reach.items() if package in seen]


def test_the_nouns_refuse_wrong_shapes_here() -> None:
    from sysid_bench.types import Trajectory

    t, q = np.zeros(4), np.zeros((4, 2))
    assert len(Trajectory(t, q, q, q)) == 4
    with pytest.raises(TypeError, match="Trajectory"):
        Trajectory(t, q, q, q[:3])
