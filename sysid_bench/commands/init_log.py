"""Verb `init log`: a first description of a recording, with guesses and doubts as comments."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sysid_bench.commands.init import relative_to, toml_value, write_new
from sysid_bench.commands.request import OK, Request, argument, option, python_function
from sysid_bench.commands.result import Result
from sysid_bench.errors import UsageError, first_names

if TYPE_CHECKING:
    from sysid_bench.models.robot import RobotModel
    from sysid_bench.signals.log_checks import Finding
    from sysid_bench.signals.log_guess import LogGuess


class InitLog(Request["InitLogResult"]):
    """Write the description of a recording: its columns, units and time are guessed."""

    files: str | Path | Sequence[str | Path] = argument(
        "FILES...", several=True, path="new", complete="files"
    )
    model: str | Path = option("Robot: a name, a URDF or an MJCF file.", complete="robots files")
    out: str | Path | None = option(
        "File of the description. Default: FILE.toml beside it.",
        default=None, flags="-o --out", path="new", complete="files",
    )  # fmt: skip
    force: bool = False
    robots_dir: Path | None = None

    def run(self) -> "InitLogResult":
        """Write the description of a recording in one or several files, beside the first one.

        Columns, units and time are guessed from names, numbers and the limits of the model; what is
        guessed, why, and what is doubtful stands in comments, with what each block of columns is.
        Of a recording without torques, or with currents, the rest is written, with what it lacks.
        Raises UsageError for files without positions, and for
        an existing description without `force`.
        """
        from sysid_bench.models.load import load_robot
        from sysid_bench.models.manifest import find_manifest
        from sysid_bench.signals.log_guess import GAINS_OF_FILE, guess_log
        from sysid_bench.signals.log_reader import read_table

        paths = self._paths()
        if not paths:
            raise UsageError("Which recording? Name its file: init log run.csv --model my.urdf.")
        first = paths[0]
        beside = first.parent / f"{first.name if first.is_dir() else first.stem}.toml"
        target = beside if self.out is None else Path(self.out)
        robot = load_robot(find_manifest(str(self.model), self.robots_dir))
        tables = [(relative_to(path, target.parent), read_table(path)) for path in paths]
        guess = guess_log(tables, robot)
        doubts, accepted = list(guess.warnings), ""
        if not guess.lacks:
            findings = self._findings(guess, target, robot)
            doubts += [one.text for one in findings]
            accepted = ",".join(dict.fromkeys(one.name for one in findings if one.contradiction))
        command = f"sysid-bench identify {self.model} --log {target}"
        if "pd" in (guess.keys.get("tau") or guess.proposal or {}):
            command += " --task actuators"
            command += " --also gain" if any(GAINS_OF_FILE in text for text in doubts) else ""
        if accepted:
            command += f" --accept {accepted}  # or settle the doubts first"
        write_new(target, _text(guess, doubts, self.model), self.force)
        return InitLogResult(
            file=str(target),
            model=str(self.model),
            joints=list(guess.keys["joints"]),
            doubts=doubts,
            unused=list(guess.unused),
            next=f"complete tau in {target}, then: {command}" if guess.lacks else command,
        )

    def _findings(self, guess: "LogGuess", target: Path, robot: "RobotModel") -> "list[Finding]":
        """Contradictions in the recording as guessed, and what was left out of it; raise UsageError
        where it cannot be read."""
        from sysid_bench.signals.log import read_log
        from sysid_bench.signals.log_description import description_of

        try:
            log = read_log(description_of(guess.keys, target), robot)
        except UsageError as error:
            reason = str(error).removeprefix(f"{target}: ")
            raise UsageError(
                f"{', '.join(map(str, self._paths()))}: nothing is written, since the guessed "
                f"description cannot be read: {reason} Write one by hand: joints, q = {{ columns = "
                "[...] }, tau."
            ) from error
        return [one for one in log.findings if one.contradiction or one.name == "non-finite"]

    def _paths(self) -> list[Path]:
        files = [self.files] if isinstance(self.files, (str, Path)) else self.files
        return list(map(Path, files))

    def plugins(self) -> Iterable[tuple[str, str | None]]:
        from sysid_bench.experiments.third_party import reader_candidates

        return [plugin for file in self._paths() for plugin in reader_candidates(file)]

    def shell(self, as_json: bool) -> int:
        from sysid_bench.commands.progress import read_progress
        from sysid_bench.commands.terminal import print_result

        with read_progress():
            result = self.run()
        print_result(result, as_json)
        return OK


init_log = python_function(InitLog, "init_log")


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


def _text(guess: "LogGuess", doubts: Sequence[str], model: str | Path) -> str:
    """Text of the description: doubts first, then a line a key with its reason."""
    lines = [f"# Recording for {model}; written by sysid-bench init log. Check what it guessed."]
    lines += [f"# DOUBT: {_one_line(doubt)}" for doubt in doubts]
    lines += [f"#   {_one_line(line)}" for line in guess.explained]
    for entry in guess.entries:
        lines += [f"# {_one_line(entry.reason)}"] if entry.reason else []
        lines.append(f"{entry.name} = {toml_value(entry.value)}")
    absent = bool(guess.lacks) and "tau" not in guess.keys and "preset" not in guess.keys
    lines += [f"# tau = {toml_value(guess.proposal)}    # to be completed"] if absent else []
    lines += [
        "# payload = { use = 'box-2kg' }    # what was mounted, if known",
        "# rows = [1, 2000]                 # part of the samples, counted from 1",
    ]
    return "\n".join(lines) + "\n"


def _one_line(text: str) -> str:
    return " ".join(text.split())
