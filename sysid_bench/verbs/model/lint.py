"""What is wrong with model files as models of dynamics."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

from sysid_bench.apps.surveys.source_folder import is_source, source_folder
from sysid_bench.errors import UsageError, count_text
from sysid_bench.input_files import is_folder
from sysid_bench.models.lint import find_model_files, lint_model
from sysid_bench.models.lint_input import SEVERITIES, LintFinding
from sysid_bench.models.manifest import Manifest, find_manifest
from sysid_bench.models.sources import source_settings
from sysid_bench.verbs.result import Result


@dataclass(frozen=True, eq=False, repr=False)
class LintResult(Result):
    """Findings of all models, errors of each first, and their number by severity."""

    models: int
    counts: dict[str, int]
    findings: list[dict[str, Any]]
    texts: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """True where no finding is an error."""
        return not self.counts["error"]

    def summary(self) -> str:
        """A line per finding, then counts."""
        counts = ", ".join(count_text(count, name) for name, count in self.counts.items())
        return "\n".join([*self.texts, f"{count_text(self.models, 'model')}: {counts}"])

    def _fields(self) -> dict[str, Any]:
        return {key: value for key, value in super()._fields().items() if key != "texts"}


def lint(sources: Sequence[str | Path], robots_dir: Path | None = None) -> LintResult:
    """Check models: names of robots, model files, robot.toml, folders of models, collections.

    `[lint] ignore = ["rotor-inertia", "mass:link3"]` in a robot.toml suppresses findings. Raises
    UsageError for a name or file that does not exist, and for a folder without models.
    """
    models: list[Manifest] = []
    broken: list[LintFinding] = []
    for source in sources:
        of_source, unreadable = _models(str(source), robots_dir)
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


def _models(source: str, robots_dir: Path | None) -> tuple[list[Manifest], list[LintFinding]]:
    """Models of a source, and findings in place of those that cannot be read."""
    plain, settings = source_settings(source)
    folder = _folder_of(plain.removeprefix("file:"))
    if not is_folder(folder) or (folder / "robot.toml").is_file():
        return [find_manifest(source, robots_dir)], []
    models, findings = find_model_files(folder)
    if not models and not findings:
        raise UsageError(
            f"{source!r} holds no robot.toml and no URDF or MJCF model; give a folder of models."
        )
    return [replace(model, **settings) for model in models], findings


def _folder_of(path: str) -> Path:
    """The folder of a path, or of a collection of models."""
    if is_source(path) and not is_folder(Path(path)):
        return source_folder(path)
    return Path(path)
