"""Parts of the checks that changed files need: `python .ci/parts.py [BASE]` prints targets of make.

BASE is a commit of git (default: origin/main, else main); changes that are not committed count,
too. A file that no rule names needs every part, so that a new folder is never left out in silence.
"""

import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Final

PARTS: Final = (
    "test", "long", "faults", "cluster", "gate", "docs", "lint", "reference-check", "bench",
)  # fmt: skip
"""Targets of make, each of which a machine of its own can run."""

_CODE = ("test", "long", "faults", "gate", "docs", "lint", "reference-check")
RULES: Final[tuple[tuple[str, tuple[str, ...]], ...]] = (
    # The first that fits decides; a rule with / at its end is a folder. Quick tests ask that each
    # option stands in a page, and that pages, targets and workflows name each other.
    ("docs/", ("test", "long", "docs", "lint")),
    ("mkdocs.yml", ("test", "docs")),
    ("README.md", ("test", "long", "docs")),
    ("CONTRIBUTING.md", ("test", "long", "docs")),
    ("CHANGELOG.md", ("docs",)),
    ("LICENSE", ()),
    ("CITATION.cff", ("test",)),
    (".conda/", ("test",)),
    (".gitignore", ()),
    (".github/", ("test",)),
    ("reports/make/", ("test", "long", "lint", "reference-check")),
    ("reports/", ("test", "long", "docs", "reference-check")),
    ("tests/benchmarks/", ("bench", "lint")),
    ("tests/faults/", ("faults", "lint")),
    ("tests/cluster/", ("cluster", "lint")),
    ("tests/baselines/", ("gate",)),
    # Worlds and robots that other parts import.
    ("tests/conftest.py", ("test", "long", "faults", "cluster", "lint", "bench")),
    ("tests/robots.py", ("test", "long", "faults", "lint", "bench")),
    ("tests/harness/", ("test", "long", "faults", "lint")),
    ("tests/signals/", ("test", "long", "faults", "lint")),
    ("tests/experiments/", ("test", "long", "lint", "bench")),
    ("tests/simulation/", ("test", "long", "lint", "bench")),
    ("tests/other_package.py", ("test", "long", "cluster", "lint")),
    ("tests/", ("test", "long", "lint")),
    ("sysid_bench/apps/clusters/", (*_CODE, "cluster")),
    ("sysid_bench/harness/", (*_CODE, "cluster")),
    ("sysid_bench/regressors/", (*_CODE, "bench")),
    ("sysid_bench/simulation/", (*_CODE, "bench")),
    ("sysid_bench/", _CODE),
    ("robots/", ("test", "long", "gate", "docs", "reference-check")),
    ("suites/", ("test", "long", "gate", "docs", "reference-check")),
    ("data/", ("test", "long", "docs", "reference-check")),
)


def parts_of(files: Iterable[str]) -> list[str]:
    """Return the parts that the changed files need, in the order of PARTS."""
    needed: set[str] = set()
    for file in files:
        found = (
            parts
            for rule, parts in RULES
            if file == rule or (rule.endswith("/") and file.startswith(rule))
        )
        needed.update(next(found, PARTS))
    return [part for part in PARTS if part in needed]


def changed_files(base: str) -> list[str]:
    """Return the files that differ from where this branch left `base`, new ones as well."""
    start = _git("merge-base", base, "HEAD")[0]
    return sorted(
        {*_git("diff", "--name-only", start), *_git("ls-files", "-o", "--exclude-standard")}
    )


def _git(*arguments: str) -> list[str]:
    done = subprocess.run(["git", *arguments], text=True, capture_output=True, check=True)
    return done.stdout.splitlines()


def main(arguments: list[str]) -> int:
    """Print the parts, with a word for none."""
    known = subprocess.run(
        ["git", "rev-parse", "-q", "--verify", "origin/main"], capture_output=True
    )
    base = arguments[0] if arguments else "main" if known.returncode else "origin/main"
    try:
        print(" ".join(parts_of(changed_files(base))) or "lint")
    except subprocess.CalledProcessError as error:
        # A clone without history cannot know what changed: everything runs.
        print(f"{Path(__file__).name}: {error.stderr.strip()}; all parts", file=sys.stderr)
        print(" ".join(PARTS))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
