"""Requests: one declaration serves the shell, Python, help and completion; verbs of other packages
join by their entry points."""

import inspect
import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner, Result

import sysid_bench
from sysid_bench.commands.main import Verbs, main
from sysid_bench.commands.request import Request, argument, model, option, python_function, spec_of
from sysid_bench.commands.shell import click_command
from sysid_bench.commands.table import FIRST, GROUPS, VERBS
from sysid_bench.errors import UsageError
from sysid_bench.reference.pages import commands

ROOT = Path(__file__).parents[2]


class Ask(Request[dict[str, Any]]):
    """Ask for something."""

    what: str = argument("WHAT")
    models: tuple[str, ...] = model("MODEL...", several=True)
    count: int = option("How often.", default=2, least=1, shown=True)
    period: float = option("Time of one.", default=0.5, unit="s", shown="0.5 s")
    tags: tuple[str, ...] = option("A tag.", default=(), flags="-t --tag", several=True)
    pairs: Mapping[str, str] = option(
        "Pairs.", default={}, parse=lambda text: dict([text.split("=")])
    )
    share: float | None = option("A share.", default=None, when=("--log", "--task hard"))
    log: Path | None = option("A file.", default=None)
    task: str = option("Kind of it.", default="easy", choices=("easy", "hard"))
    notice: object = None

    def run(self) -> dict[str, Any]:
        """Return all fields."""
        return {key: value for key, value in vars(self).items() if value is not None}

    def shell(self, as_json: bool) -> int:
        click.echo(json.dumps(self.run(), default=str))
        if self.count == 7:
            raise UsageError("Seven is too many; ask for six.")
        return 3


VERB = click_command(Ask, "ask")
ask = python_function(Ask, "ask")


def called(*words: str) -> Result:
    return CliRunner().invoke(VERB, words)


def test_options_become_fields() -> None:
    done = called(
        *("it", "a", "b", "--period", "20 ms", "-t", "x", "--tag", "y", "--pairs", "k=v"),
        *("--log", "run.toml"),
    )
    assert done.exit_code == 3, done.output
    assert json.loads(done.stdout) == {
        "what": "it", "models": ["a", "b"], "count": 2, "period": 0.02,
        "tags": ["x", "y"], "pairs": {"k": "v"}, "log": "run.toml", "task": "easy",
    }  # fmt: skip


def test_what_is_not_given_is_as_in_python() -> None:
    assert json.loads(called("it", "a").stdout) == json.loads(json.dumps(ask("it", ("a",))))


@pytest.mark.parametrize(
    ("words", "culprit"),
    [
        (("it",), "MODEL..."),
        (("it", "a", "--count", "0"), "--count"),
        (("it", "a", "--task", "odd"), "easy"),
        (("it", "a", "--period", "1 kg"), "'1 kg'"),
        (("it", "a", "--count", "7"), "ask for six"),
    ],
)
def test_what_is_wrong_is_named_with_exit_code_2(words: tuple[str, ...], culprit: str) -> None:
    done = called(*words)
    assert done.exit_code == 2
    assert culprit in done.stderr
    assert "Traceback" not in done.output


def test_help_shows_what_has_a_use_with_the_line() -> None:
    def options(*words: str) -> set[str]:
        text = called(*words).stdout.partition("Options:")[2].partition("More options")[0]
        return {line.split()[0] for line in text.splitlines() if line.startswith("  -")}

    plain = options("--help")
    assert {"--count", "--log", "--help-all"} < plain
    assert "--share" not in plain
    assert "--log, --task hard" in called("--help").stdout
    for words in (
        ("--log", "-h"),
        ("--log=x", "--help"),
        ("--task", "hard", "-h"),
        ("--help-all",),
    ):
        assert options(*words) - plain == {"--share"}, words
    assert options("--task", "easy", "--help") == plain


def test_help_shows_defaults_as_they_are_typed() -> None:
    text = called("--help").stdout
    assert "[default: 0.5 s]" in text
    assert "[default: 2; x>=1]" in text


def test_the_python_function_has_the_signature_of_the_request() -> None:
    signature = inspect.signature(ask)
    assert list(signature.parameters) == list(vars(Ask("it", ())))
    assert signature.parameters["count"].default == 2
    assert str(ask.__doc__).startswith("Return all fields.")
    assert "`period`: Time of one." in str(ask.__doc__)
    with pytest.raises(TypeError, match="wat"):
        ask("it", ("a",), wat=1)  # type: ignore[call-arg]


def _requests() -> dict[str, type[Request[Any]]]:
    found = {}
    for name, verb in VERBS.items():
        if not verb.target:  # the word before others
            continue
        module, _, attribute = verb.target.partition(":")
        made = getattr(import_module(module), attribute)
        if not isinstance(made, click.Command):
            found[name] = made
    return found


def test_sentences_of_the_table_are_the_first_of_each_help() -> None:
    for name, request in _requests().items():
        assert " ".join(str(request.__doc__).split()).startswith(VERBS[name].sentence), name
    assert {verb.group for verb in VERBS.values()} < set(GROUPS)
    assert set(FIRST) < set(VERBS)


EXAMPLES = {
    "also": "gain", "at": "hip=0.5", "boxes": "hand=0:1,0:1,0:1", "contacts": "10 s to 25 s",
    "gains": "kp=30", "limits": "v=1", "metrics": "rank", "noise": "tau=1 %", "others": "cycles=2",
    "overrides": "run.repeats=2", "pipeline": "raw", "prior": "none", "seed": "7", "terms": "none",
    "tolerances": "rank=2",
}  # fmt: skip
"""A value of each option whose text is parsed; others take any."""


def example(param: click.Parameter, unit: str | None, folder: Path) -> str:
    """What a user may type for an option or an argument."""
    if isinstance(param.type, click.Choice):
        return str(param.type.choices[-1])
    if isinstance(param.type, click.Path):
        return str(folder if not param.type.file_okay else folder / "file")
    if isinstance(param.type, click.types.FloatParamType):
        return "0.25"
    if isinstance(param.type, click.types.IntParamType):
        return "7"
    return f"0.25 {unit}" if unit else EXAMPLES.get(str(param.name), "other")


@pytest.mark.parametrize("name", _requests())
def test_every_option_sets_its_field_and_no_other(name: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    request, asked = _requests()[name], list[Request[Any]]()

    class Asked(request):  # type: ignore[valid-type, misc]
        def shell(self, as_json: bool) -> int:
            asked.append(self)
            return 0

        def plugins(self) -> list[tuple[str, str | None]]:
            return []

    units = {entry.name: spec.unit for entry in fields(Asked) if (spec := spec_of(entry))}
    verb = click_command(Asked, name)
    arguments, options = [], []
    for param in verb.params:
        value = example(param, units.get(str(param.name)), tmp_path)
        if isinstance(param, click.Argument):
            arguments.append(value)
        elif param.required:
            arguments += [param.opts[-1], value]
        elif param.name != "as_json":
            is_flag = isinstance(param, click.Option) and param.is_flag
            words = [(param.secondary_opts or param.opts)[-1]] + ([] if is_flag else [value])
            options.append((str(param.name), words))
    for chosen in (None, *options):
        line = [*arguments, *(chosen[1] if chosen else ())]
        done = CliRunner().invoke(verb, line)
        assert done.exit_code == 0, (line, done.output)
    plain, *others = asked
    for (field, words), found in zip(options, others, strict=True):
        changed = {key for key in vars(plain) if vars(plain)[key] != vars(found)[key]}
        assert changed == {field}, words


def test_every_option_stands_in_a_page() -> None:
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    pages += (ROOT / "reports" / "reference").glob("*.md")
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    silent = [
        f"{name} {param.opts}"
        for name, command in commands(main)
        for param in command.params
        if isinstance(param, click.Option)
        and not any(
            re.search(rf"(?<![\w-]){word}(?![\w-])", text)
            for word in (*param.opts, *param.secondary_opts)
        )
    ]
    assert not silent


def test_a_person_can_hold_the_options() -> None:
    """Few of them, each with a sentence."""
    records = [
        (name, param.get_help_record(click.Context(command)))
        for name, command in commands(main)
        for param in command.params
        if isinstance(param, click.Option)
    ]
    assert len(records) <= 190, "cut an option, or make the new one a field of Python alone"
    for name, record in records:
        assert record is not None, name
        assert record[1].partition("  [")[0].endswith("."), f"{name} {record}"


@pytest.mark.parametrize("name", _requests())
def test_help_of_a_verb_loads_nothing_heavy(name: str) -> None:
    heavy = ["numpy", "mujoco", "pinocchio", "pydantic", "scipy", "pandas"]
    code = (
        "import sys\nfrom sysid_bench.commands.main import main\n"
        f"main([*{name.split()!r}, '--help'], standalone_mode=False)\n"
        f"print([name for name in {heavy!r} if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, text=True, capture_output=True, timeout=60
    )
    assert done.stdout.splitlines()[-1:] == ["[]"], done.stderr


OTHER = '''
from sysid_bench.commands.request import Request, argument


class Count(Request[None]):
    """Count letters."""

    text: str = argument("TEXT")

    def shell(self, as_json):
        print(len(self.text))
        return 4
'''


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An installed package with the verbs `count`, a broken one, and one called as ours."""
    (tmp_path / "other_verbs.py").write_text(OTHER)
    folder = tmp_path / "other-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text(
        "[sysid_bench.commands]\ncount = other_verbs:Count\nbroken = other_verbs:Nothing\n"
        "list = other_verbs:Count\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path


def test_another_package_adds_verbs_and_replaces_none(package: Path) -> None:
    runner = CliRunner()
    text = runner.invoke(main, ["--help"]).stdout
    assert GROUPS["other"] in text
    assert "Verb of the package other." in text
    assert "other_verbs" not in sys.modules
    done = runner.invoke(main, ["count", "four"])
    assert (done.exit_code, done.stdout) == (4, "4\n")
    assert "robots" in runner.invoke(main, ["list", "--help"]).stdout
    refused = runner.invoke(main, ["broken"])
    assert refused.exit_code == 2
    assert "'broken' cannot be imported" in refused.stderr


def test_verbs_with_a_common_word_are_a_group(monkeypatch: pytest.MonkeyPatch) -> None:
    from sysid_bench.commands import main as module
    from sysid_bench.commands import table

    verbs = {
        "own": table.Verb("own", "", "Own things."),
        "own list": VERBS["list"],
    }
    monkeypatch.setattr(module, "all_verbs", lambda: verbs)
    monkeypatch.setattr(module, "find_verb", verbs.get)
    group = Verbs("program")
    assert dict(commands(group)).keys() == {"own", "own list"}
    assert "List the names" in CliRunner().invoke(group, ["own", "--help"]).stdout
    done = CliRunner().invoke(group, ["own", "list", "payloads", "--json"])
    assert {entry["name"] for entry in json.loads(done.stdout)} >= {"none"}


def test_public_functions_are_those_of_requests() -> None:
    assert os.fspath(inspect.getfile(inspect.unwrap(sysid_bench.frames))).endswith("request.py")
    assert list(inspect.signature(sysid_bench.frames).parameters) == ["source", "at", "robots_dir"]


@pytest.mark.parametrize(
    "words", [("basis", "ur5", "--tool", "x"), ("lint", "--assets=x", "a.xml")]
)
def test_an_option_of_earlier_versions_is_answered_with_its_replacement(
    words: Sequence[str],
) -> None:
    done = CliRunner().invoke(main, list(words))
    assert done.exit_code == 2
    assert "any more" in done.output
    assert f"?{'tool' if '--tool' in words else 'assets'}=" in done.output
