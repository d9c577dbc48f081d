"""Environments beside which sysid_bench is tried: `try` prints the table of docs/where-it-runs.md,
`tests` runs the tests with lowest or newest versions, or with one extra left out.

Each environment is made below --folder, one at a time, and removed; what was found is kept in
results.json there, so that the same command goes on where it stopped (--again repeats it). Needs
`uv` on the path, or UV naming it. Interpreters: those that uv finds.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).resolve().parents[1]
UV: Final = os.environ.get("UV", "uv")
WHEELS: Final = ("mujoco", "mujoco-core", "pin", "scipy", "numpy", "pandas", "pyarrow")
LINUX: Final = "x86_64-manylinux_2_35"


@dataclass(frozen=True)
class Environment:
    """Requirements beside the core, and for which Python and platform."""

    name: str
    beside: tuple[str, ...] = ()
    python: str = "3.12"
    platform: str = LINUX
    install: bool = True  # False: resolved alone, for its size or its platform


ENVIRONMENTS: Final = (
    Environment("LeRobot newest", ("lerobot",)),
    Environment("LeRobot 0.4", ("lerobot==0.4.4",)),
    Environment("mjlab 1.6", ("mjlab==1.6.0",)),
    # What isaaclab 3 asks for besides Omniverse, whose wheels have an index of their own.
    Environment("Isaac Lab's requirements", ("isaaclab",), install=False),
    # ROS 2 Jazzy: the packages of Ubuntu 24.04.
    Environment("ROS 2 Jazzy", ("numpy==1.26.4",), install=False),
    Environment("Drake", ("drake",)),
    Environment("MJX, playground", ("mujoco-mjx", "playground")),
    Environment("newton", ("newton",)),
    Environment("FIGAROH", ("figaroh",)),
    Environment("Windows", platform="windows", install=False),
    Environment("Intel Mac", platform="x86_64-apple-darwin", install=False),
    Environment("Apple silicon", platform="aarch64-apple-darwin", install=False),
    Environment("the core", ()),
    Environment("core and all extras", ("sysid-bench[all]",)),
)
COMMANDS: Final = (
    ("crosscheck", "ur5", "panda", "solo12"),
    ("identify", "ur5", "--simulate"),
    ("run", "smoke", "-o", "smoke"),
)
EXTRAS: Final = ("test", "robots", "rerun", "parquet", "logs", "peers")
DISTRIBUTION: Final = {"rerun": "rerun-sdk", "robots": "example-robot-data", "parquet": "pyarrow"}


def run(*words: str, **more: Any) -> subprocess.CompletedProcess[str]:
    """Run a program; its texts are kept."""
    return subprocess.run([str(w) for w in words], text=True, capture_output=True, **more)


def resolve(one: Environment) -> tuple[list[str], str]:
    """Return the pinned packages; or none, and why."""
    core = [w for w in one.beside if w.startswith("sysid-bench")] or ["sysid-bench"]
    asked = [f"{core[0]} @ {ROOT.as_uri()}", *(w for w in one.beside if w not in core)]
    # Wheels alone of what nobody compiles by the way.
    wheels = [x for name in WHEELS for x in ("--only-binary", name)]
    done = run(
        UV, "pip", "compile", "-q", "--no-header", "--no-annotate", "--python-version", one.python,
        "--python-platform", one.platform, *wheels, "-", input="\n".join(asked),
    )  # fmt: skip
    if done.returncode:
        return [], " ".join(done.stderr.split())[:400]
    lines = [line.split(";")[0].strip() for line in done.stdout.splitlines()]
    return [line for line in lines if line and not line.startswith(("#", "--"))], ""


def attempt(one: Environment, folder: Path) -> dict[str, Any]:
    """Resolve an environment, and install and use it where it is to be."""
    packages, reason = resolve(one)
    found: dict[str, Any] = {"packages": len(packages), "reason": reason}
    wanted = ("numpy", "mujoco", "pin", "scipy", "pandas")
    found["versions"] = [p for p in packages if p.partition("==")[0] in wanted]
    if reason or not one.install:
        return found
    place = folder / "environment"
    shutil.rmtree(place, ignore_errors=True)
    try:
        run(UV, "venv", "-q", "-p", one.python, place, check=True)
        (folder / "packages.txt").write_text("\n".join(packages) + "\n")
        run(
            UV,
            "pip",
            "install",
            "-q",
            "-p",
            place / "bin/python",
            "-r",
            folder / "packages.txt",
            check=True,
        )
        found["megabytes"] = sum(f.stat().st_size for f in place.rglob("*") if f.is_file()) // 10**6
        for words in COMMANDS:
            done = run(place / "bin/sysid-bench", *words, cwd=place, timeout=900)
            found[words[0]] = done.returncode
    except subprocess.CalledProcessError as error:
        found["reason"] = " ".join(str(error.stderr).split())[-300:]
    finally:
        shutil.rmtree(place, ignore_errors=True)
    return found


def tests(name: str, folder: Path) -> dict[str, Any]:
    """Run `make test` with the lowest or newest versions, or without an extra."""
    place = folder / "environment"
    shutil.rmtree(place, ignore_errors=True)
    left_out = name.removeprefix("without-")
    extras = [extra for extra in EXTRAS if extra != left_out]
    lowest = name == "lowest"
    python = (
        "3.11"
        if lowest
        else os.environ.get("NEWEST_PYTHON", f"{sys.version_info[0]}.{sys.version_info[1]}")
    )
    # With pip: `fetch` loads models by it.
    run(UV, "venv", "-q", "--seed", "-p", python, place, check=True)
    words = ["--resolution", "lowest-direct"] if lowest else []
    # pin 3 loads beside old libraries alone; numpy 2.0 needs pin 4.
    more = ["pin>=4"] if lowest else []
    run(
        UV, "pip", "install", "-q", *words, "-p", place / "bin/python", "-e",
        f"{ROOT}[{','.join(extras)}]", *more, check=True,
    )  # fmt: skip
    if name == "without-pin":
        run(
            UV,
            "pip",
            "uninstall",
            "-q",
            "-p",
            place / "bin/python",
            "pin",
            "libpinocchio",
            check=True,
        )
    fixed = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": ""}
    done = run(
        place / "bin/python", "-m", "pytest", "-q", "-m", "not long and not tutorial", "-n",
        os.environ.get("JOBS", "2"), "--benchmark-disable", "--ignore=tests/benchmarks",
        "--ignore=tests/faults", "--ignore=tests/cluster", cwd=ROOT, env={**os.environ, **fixed},
    )  # fmt: skip
    (folder / f"{name}.txt").write_text(done.stdout + done.stderr)
    shutil.rmtree(place, ignore_errors=True)
    return {"code": done.returncode, "result": done.stdout.strip().splitlines()[-1:]}


def table(results: dict[str, Any]) -> str:
    """Return what was found, as Markdown."""
    lines = ["| environment | packages | result |", "| --- | ---: | --- |"]
    for one in ENVIRONMENTS:
        found = results.get(one.name)
        if found is None:
            continue
        codes = [f"{words[0]} {'ok' if found[words[0]] == 0 else found[words[0]]}"
                 for words in COMMANDS if words[0] in found]  # fmt: skip
        size = f"{found['megabytes']} MB: " if "megabytes" in found else ""
        said = found["reason"] or size + (", ".join(codes) or "resolved")
        lines.append(
            f"| {one.name} | {found['packages'] or ''} | {said} ({', '.join(found['versions'])}) |"
        )
    return "\n".join(lines)


def main() -> int:
    """Try the environments, or run tests in some."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("try", "tests"))
    parser.add_argument("names", nargs="*")
    parser.add_argument("--folder", type=Path, default=Path("/tmp/sysid-bench-environments"))
    parser.add_argument("--again", action="store_true")
    given = parser.parse_intermixed_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    file = given.folder / "results.json"
    results = json.loads(file.read_text()) if file.is_file() and not given.again else {}
    by_name = {one.name: one for one in ENVIRONMENTS}
    for name in given.names or (by_name if given.what == "try" else ()):
        if name in results:
            continue
        found = (
            attempt(by_name[name], given.folder)
            if given.what == "try"
            else tests(name, given.folder)
        )
        results[name] = found
        file.write_text(json.dumps(results, indent=1))
        print(f"{name}: {found}", file=sys.stderr, flush=True)
    if given.what == "try":
        print(table(results))
        return 0
    return max((results[name]["code"] for name in given.names), default=0)


if __name__ == "__main__":
    sys.exit(main())
