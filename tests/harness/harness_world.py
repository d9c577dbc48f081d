"""Suites with names that need no robot: what tests plan and run."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.harness.suite.load_suite import parse_suite
from sysid_bench.harness.suite.model import Suite
from sysid_bench.harness.suite.names import CheckedName, Names

PLUGINS = {
    "estimator": ("ols", "wls", "didim", "mylab.methods:Geodesic"),
    "excitation": ("fourier", "fourier-other", "ptp"),
    "simulation": ("inverse", "closed-loop"),
    "plant": ("matched", "stribeck"),
    "pipeline": ("plain", "raw", "parallel"),
}


def _robot(source: str, folder: Path | None) -> CheckedName:
    if source.startswith("file:"):
        return CheckedName(Path(source.removeprefix("file:")).stem)
    if source not in ("ur5", "panda", "go2"):
        raise unknown_name("robot", source, ("ur5", "panda", "go2"))
    return CheckedName(source, free_base=source == "go2")


def _payload(spec: str | Mapping[str, Any]) -> CheckedName:
    if not isinstance(spec, str):
        if spec["mass"] <= 0:
            raise UsageError(f"A payload's mass must be positive (kg); got {spec['mass']}.")
        return CheckedName(spec.get("name", f"{spec['mass']}kg"), mass=spec["mass"])
    if spec not in ("none", "sphere-1kg"):
        raise unknown_name("payload", spec, ("none", "sphere-1kg"))
    return CheckedName(spec, mass=0.0 if spec == "none" else 1.0)


def _plugin(kind: str, spec: Mapping[str, Any]) -> None:
    if spec["use"] not in PLUGINS[kind] and not spec["use"].startswith("file:"):
        raise unknown_name(kind, spec["use"], PLUGINS[kind])


NAMES = Names(_robot, _payload, _plugin)

FULL = """
schema = 1
name   = "smoke"
title  = "Three robots"
seed   = 20261121

[run]
timeout = "60 s"
threads = 1
repeats = 3

[defaults]
task       = "robot"
plant      = "matched"
terms      = []
prior      = { mass = "20 %", com = "15 mm", inertia = "30 %" }
excitation = { use = "fourier", harmonics = 5, period = "5 s", cycles = 2 }
held_out   = ["fourier-other", "ptp"]
simulation = { use = "inverse" }
rate       = "200 Hz"
noise      = [{}, { q = "1e-4 rad", tau = "0.5 %" }]
signals    = { filter = "butter 4 20 Hz zero-phase", derivatives = "from q" }

[[robot]]
use      = ["ur5", "panda"]
payloads = ["none", "sphere-1kg", { mass = 1.2, com = [0.02, 0, 0.05], inertia = "point" }]
[[robot]]
use      = "file:models/my_arm.urdf"
payloads = ["none"]

[[estimator]]
use = "ols"
[[estimator]]
use = "mylab.methods:Geodesic"
label = "Geodesic (ours)"

[[exclude]]
when   = 'estimator == "didim" and robot.free_base'
reason = "needs a fixed base"

[crosscheck]
tolerance = 1e-12
on_fail   = "skip-robot"

[[table]]
name    = "main"
rows    = ["robot", "payload"]
columns = ["estimator"]
cells   = { metric = "torque_error", stat = "median", interval = "iqr" }
best    = "min-bold"

[record]
when   = 'status != "ok"'
worst  = { metric = "torque_error", count = 1, per = "robot" }
max_hz = 50
"""


def small(body: str = "", seed: int = 1, estimators: str = '[[estimator]]\nuse = "ols"\n') -> str:
    """A suite of one cell; `body` comes before its robot."""
    return (
        f'schema = 1\nname = "small"\nseed = {seed}\n{body}\n[[robot]]\nuse = "ur5"\n{estimators}'
    )


def read(text: str) -> Suite:
    return parse_suite(text, "suite.toml", None, NAMES)
