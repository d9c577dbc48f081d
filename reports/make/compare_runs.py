"""Costs of comparing two runs of many cells: seconds of CPU, sizes, and the lines of a diff.

python -m reports.make.compare_runs FOLDER [CELLS] makes two runs in FOLDER, of which the second
differs in one of two robots, saves their baselines and compares them.
"""

import difflib
import sys
from pathlib import Path

from reports.make.large_run import make_run, measured

CHANGED = "ur10"


def main(folder: str, cells: str = "5000") -> None:
    """Print a line for each command, and what it wrote."""
    place = Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    runs: dict[str, tuple[str, ...]] = {"before": (), "after": (CHANGED,)}
    for name, changed in runs.items():
        if not (place / name).is_dir():
            make_run(place / name, int(cells), changed).write_frames()
    steps = {}
    for name in runs:
        target = str(place / f"{name}.json")
        steps[f"baseline save {name}"] = ["baseline", "save", str(place / name), "-o", target]
    pair = [str(place / name) for name in runs]
    steps["compare"] = ["compare", *pair]
    steps["compare --html"] = ["compare", *pair, "--html", str(place / "compare.html")]
    steps["gate (fails)"] = ["gate", pair[1], "--baseline", str(place / "before.json")]
    for name, words in steps.items():
        code = f"from sysid_bench.commands.main import main; main({words!r}, standalone_mode=False)"
        seconds, cpu, memory = measured(code)
        print(f"{name:<20} {seconds:6.1f} s {cpu:6.1f} s CPU {memory:6.0f} MB", flush=True)
    for file in ("before.json", "compare.html"):
        print(f"{file:<20} {(place / file).stat().st_size / 1e6:6.2f} MB")
    before, after = ((place / f"{name}.json").read_text().splitlines() for name in runs)
    matcher = difflib.SequenceMatcher(None, before, after, autojunk=False)
    differing = [op for op in matcher.get_opcodes() if op[0] != "equal"]
    first, last = differing[0][1], differing[-1][2]
    starts = [n for n, line in enumerate(before) if line.startswith('  "')]
    robot = max(n for n in starts if n <= first)
    inside = last <= min((n for n in starts if n > robot), default=len(before))
    print(f"diff                 lines {first + 1} to {last} of {len(before)}", end="")
    print(f", all of {before[robot].strip(' {')}" if inside else ", of more robots than one")


if __name__ == "__main__":
    main(*sys.argv[1:])
