"""First description of a recording, with guesses and doubts as comments: init log."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomlkit

from sysid_bench.commands.result import Result
from sysid_bench.errors import UsageError, first_names
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.log import read_log
from sysid_bench.signals.log_checks import Finding
from sysid_bench.signals.log_description import description_of
from sysid_bench.signals.log_guess import LogGuess, guess_log
from sysid_bench.signals.log_reader import read_table
from sysid_bench.verbs.init.new_file import relative_to, write_new


@dataclass(frozen=True, eq=False, repr=False)
class InitLogResult(Result):
    """Written description of a recording, what is doubtful in it, the columns of the file that it
    does not use, and the command to run next."""

    file: str
    model: str
    joints: list[str]
    doubts: list[str]
    unused: list[str]
    next: str

    def summary(self) -> str:
        """File, doubts, unused columns, and the command to run next."""
        doubts = [f"  doubt: {doubt}" for doubt in self.doubts]
        unused = [f"  not used: {first_names(self.unused, 8)}"] if self.unused else []
        return "\n".join([f"{self.file} written", *doubts, *unused, f"  next: {self.next}"])


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
    guessed, why, and what is doubtful stands in comments. Of a recording without torques the
    rest is written, with what it lacks. Raises UsageError for files without positions, and for an
    existing description without `force`.
    """
    paths = _paths(files)
    target = Path(out) if out is not None else _beside(paths[0])
    robot = load_robot(find_manifest(str(model), robots_dir))
    tables = [(relative_to(path, target.parent), read_table(path)) for path in paths]
    guess = guess_log(tables, robot)
    findings = [] if guess.lacks else _findings(guess, target, robot)
    doubts = [*guess.warnings, *(finding.text for finding in findings)]
    write_new(target, _text(guess, doubts, model), force)
    return InitLogResult(
        file=str(target),
        model=str(model),
        joints=list(guess.keys["joints"]),
        doubts=doubts,
        unused=list(guess.unused),
        next=f"sysid-bench identify {model} --log {target}{_settling(guess, findings)}",
    )


def _paths(files: str | Path | Sequence[str | Path]) -> list[Path]:
    paths = [Path(files)] if isinstance(files, (str, Path)) else list(map(Path, files))
    if not paths:
        raise UsageError("Which recording? Name its file: init log run.csv --model my.urdf.")
    return paths


def _settling(guess: LogGuess, findings: Sequence[Finding]) -> str:
    """What the command needs before it can run, or contradictions that it has to accept."""
    if guess.lacks:
        return "  # once tau is written"
    accepted = ",".join(dict.fromkeys(finding.name for finding in findings))
    return f" --accept {accepted}  # or settle the doubts first" if accepted else ""


def _beside(path: Path) -> Path:
    """Description of a file or folder: run.csv has run.toml."""
    return path.parent / f"{path.name if path.is_dir() else path.stem}.toml"


def _findings(guess: LogGuess, target: Path, robot: RobotModel) -> list[Finding]:
    """Contradictions that the guessed description leaves; raise UsageError for one that cannot be
    read."""
    log = read_log(description_of(guess.keys, target), robot)
    return [finding for finding in log.findings if finding.contradiction]


def _text(guess: LogGuess, doubts: Sequence[str], model: str | Path) -> str:
    """Text of the description: doubts first, then a line a key with its reason."""
    lines = [f"# Recording for {model}; written by sysid-bench init log. Check what it guessed."]
    lines += [f"# DOUBT: {_one_line(doubt)}" for doubt in doubts]
    if guess.unused:
        lines.append(f"# Columns that are not used: {_one_line(', '.join(guess.unused))}")
    for entry in guess.entries:
        lines += [f"# {_one_line(entry.reason)}"] if entry.reason else []
        lines.append(f"{entry.name} = {toml_value(entry.value)}")
    lines += ['# tau = { columns = [], unit = "N m" }    # one column a joint'] * bool(guess.lacks)
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
        pairs = [f"{tomlkit.key(key).as_string()} = {toml_value(x)}" for key, x in value.items()]
        return f"{{ {', '.join(pairs)} }}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(toml_value, value))}]"
    return str(tomlkit.item(value).as_string())
