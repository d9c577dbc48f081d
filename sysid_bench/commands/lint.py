"""Verb `lint`: what is wrong with model files as models of dynamics."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sysid_bench.commands.request import FAILED, OK, Request, model, python_function
from sysid_bench.commands.result import HIDDEN, Result
from sysid_bench.errors import UsageError, count_text

if TYPE_CHECKING:
    from sysid_bench.models.lint import LintFinding
    from sysid_bench.models.manifest import Manifest


class Lint(Request["LintResult"]):
    """Report what is wrong with model files as models of dynamics; folders, and collections that
    were fetched, are searched.

    Impossible and placeholder inertias, masses and moments that do not fit the size of a link,
    units, limits, rotor inertias, left and right limbs that differ. Exit code 1 where a finding is
    an error; [lint] ignore = [...] in robot.toml suppresses findings.
    """

    sources: Sequence[str | Path] = model(
        "MODEL...", several=True, complete="robots collections files"
    )
    robots_dir: Path | None = None

    def run(self) -> "LintResult":
        """Check models: names of robots, model files, robot.toml, folders of models, collections.

        `[lint] ignore = ["rotor-inertia", "mass:link3"]` in a robot.toml suppresses findings.
        Raises UsageError for a name or file that does not exist, and for a folder without models.
        """
        from sysid_bench.models.lint import SEVERITIES, lint_model

        models: list[Manifest] = []
        broken: list[LintFinding] = []
        for source in self.sources:
            of_source, unreadable = _models(str(source), self.robots_dir)
            models += of_source
            broken += unreadable
        findings = [*broken, *chain.from_iterable(map(lint_model, models))]
        counts = Counter(finding.severity for finding in findings)
        return LintResult(
            models=len(models) + len(broken),
            counts={name: counts[name] for name in SEVERITIES},
            findings=[asdict(finding) for finding in findings],
            texts=tuple(finding.text for finding in findings),
        )

    def exit_code(self, result: "LintResult") -> int:
        return OK if result.ok else FAILED


lint = python_function(Lint, "lint")


@dataclass(frozen=True, eq=False, repr=False)
class LintResult(Result):
    """Findings of all models, errors of each first, and their number by severity."""

    models: int
    counts: dict[str, int]
    findings: list[dict[str, Any]]
    texts: tuple[str, ...] = field(metadata=HIDDEN)

    @property
    def ok(self) -> bool:
        """True where no finding is an error."""
        return not self.counts["error"]

    def summary(self) -> str:
        """A line per finding, then counts."""
        counts = ", ".join(count_text(count, name) for name, count in self.counts.items())
        return "\n".join([*self.texts, f"{count_text(self.models, 'model')}: {counts}"])


def _models(source: str, robots_dir: Path | None) -> "tuple[list[Manifest], list[LintFinding]]":
    """Models of a source, and findings in place of those that cannot be read."""
    from sysid_bench.input_files import is_folder
    from sysid_bench.models.collection import is_source, source_folder
    from sysid_bench.models.lint import find_model_files
    from sysid_bench.models.manifest import find_manifest
    from sysid_bench.models.sources import source_settings

    plain, settings = source_settings(source)
    path = plain.removeprefix("file:")
    folder = Path(path)
    if is_source(path) and not is_folder(folder):  # a collection of models
        folder = source_folder(path)
    if not is_folder(folder) or (folder / "robot.toml").is_file():
        return [find_manifest(source, robots_dir)], []
    models, findings = find_model_files(folder)
    if not models and not findings:
        raise UsageError(
            f"{source!r} holds no robot.toml and no URDF or MJCF model; give a folder of models."
        )
    return [replace(model, **settings) for model in models], findings
