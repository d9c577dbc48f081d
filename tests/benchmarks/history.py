"""Stored ratios of `make bench`: one that is worse by a factor than before on the same processor
is a failure. No time is stored."""

import json
import os
import platform
from collections.abc import Mapping
from pathlib import Path

FILE = Path(__file__).parents[1] / "baselines" / "speed.json"
KEEP = "SYSID_BENCH_SPEED_HISTORY"
"""The variable under which `make bench` replaces the ratios of this processor: =keep."""
FACTOR = 1.5


def stored(file: Path = FILE) -> dict[str, dict[str, float]]:
    """Ratios by processor and quantity."""
    return dict(json.loads(file.read_text(encoding="utf-8"))) if file.is_file() else {}


def worse(value: float, before: float | None, least: bool) -> bool:
    """True for a ratio that is worse than before by the factor; `least`: larger is better."""
    if before is None:
        return False
    return not (value * FACTOR >= before if least else value <= before * FACTOR)


def keep(ratios: Mapping[str, float], file: Path = FILE) -> None:
    """Replace the ratios of this processor: three digits, a line each, sorted."""
    known = stored(file)
    known[processor()] = {**known.get(processor(), {}), **ratios}
    shown = {
        name: {key: float(f"{value:.3g}") for key, value in sorted(values.items())}
        for name, values in sorted(known.items())
    }
    file.write_text(json.dumps(shown, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def keeps() -> bool:
    """True where this session replaces the stored ratios."""
    return os.environ.get(KEEP) == "keep"


def processor() -> str:
    """The processor's name."""
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for text in info.read_text().splitlines():
            if text.startswith("model name"):
                return text.partition(":")[2].strip()
    return platform.processor() or platform.machine()
