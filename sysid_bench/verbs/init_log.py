"""First description of a recording, with guesses and doubts as comments: init log."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sysid_bench.errors import UsageError
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log import read_log
from sysid_bench.signals.log_checks import Finding
from sysid_bench.signals.log_description import description_of
from sysid_bench.signals.log_guess import LogGuess, guess_log
from sysid_bench.signals.log_reader import read_table
from sysid_bench.verbs.new_file import relative_to, write_new
from sysid_bench.verbs.result import Result


@dataclass(frozen=True, eq=False, repr=False)
class InitLogResult(Result):
    """Written description of a recording, what is doubtful in it, and the command to run next."""

    file: str
    model: str
    joints: list[str]
    doubts: list[str]
    next: str

    def summary(self) -> str:
        """File, doubts, and the command to run next."""
        doubts = [f"  doubt: {doubt}" for doubt in self.doubts]
        return "\n".join([f"{self.file} written", *doubts, f"  next: {self.next}"])


def init_log(
    files: str | Path | Sequence[str | Path],
    model: str | Path,
    out: str | Path | None = None,
    *,
    force: bool = False,
    robots_dir: Path | None = None,
) -> InitLogResult:
    """Write the description of a recording in one or several files, beside the first one.

    Columns, units and time are guessed from names, numbers and the limits of the model; what is
    guessed, why, and what is doubtful stands in comments. Raises UsageError for files without
    positions and torques, and for an existing description without `force`.
    """
    paths = [Path(files)] if isinstance(files, (str, Path)) else [Path(file) for file in files]
    if not paths:
        raise UsageError("Which recording? Name its file: init log run.csv --model my.urdf.")
    target = Path(out) if out is not None else _beside(paths[0])
    robot = load_robot(find_manifest(str(model), robots_dir))
    tables = [(relative_to(path, target.parent), read_table(path)) for path in paths]
    guess = guess_log(tables, robot)
    findings = _findings(guess, target, robot)
    guess.doubts += [finding.text for finding in findings]
    write_new(target, _text(guess, model), force)
    accepted = ",".join(dict.fromkeys(finding.name for finding in findings))
    settle = f" --accept {accepted}  # or settle the doubts first" if accepted else ""
    return InitLogResult(
        file=str(target),
        model=str(model),
        joints=list(guess.keys["joints"]),
        doubts=list(guess.doubts),
        next=f"sysid-bench identify {model} --log {target}{settle}",
    )


def _beside(path: Path) -> Path:
    """Description of a file or folder: run.csv has run.toml."""
    return path.parent / f"{path.name if path.is_dir() else path.stem}.toml"


def _findings(guess: LogGuess, target: Path, robot: RobotModel) -> list[Finding]:
    """Contradictions that the guessed description leaves; raise UsageError for one that cannot be
    read."""
    log = read_log(description_of(guess.keys, target), robot)
    return [finding for finding in log.findings if finding.contradiction]


def _text(guess: LogGuess, model: str | Path) -> str:
    """Text of the description: doubts first, then a line a key with its reason."""
    lines = [f"# Recording for {model}; written by sysid-bench init log. Check what it guessed."]
    lines += [f"# DOUBT: {_one_line(doubt)}" for doubt in guess.doubts]
    for key, value in guess.keys.items():
        reason = guess.reasons[key]
        lines += [f"# {_one_line(reason)}"] if reason else []
        lines.append(f"{key} = {toml_value(value)}")
    lines += [
        "# payload = { use = 'box-2kg' }    # what was mounted, if known",
        "# rows = [1, 2000]                 # part of the samples, counted from 1",
    ]
    return "\n".join(lines) + "\n"


def _one_line(text: str) -> str:
    return " ".join(text.split())


def toml_value(value: Any) -> str:
    """Text of a value: a table or list on one line."""
    if isinstance(value, Mapping):
        pairs = ", ".join(f"{key} = {toml_value(entry)}" for key, entry in value.items())
        return f"{{ {pairs} }}"
    if isinstance(value, str):
        # The escapes of JSON are those of TOML, which also forbids a bare DEL.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Iterable):
        return f"[{', '.join(toml_value(entry) for entry in value)}]"
    return json.dumps(value)
