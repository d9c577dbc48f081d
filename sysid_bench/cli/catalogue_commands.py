"""What there is: list, show, doctor."""

import json
from pathlib import Path

import click

from sysid_bench.cli.common import (
    FAILED,
    OK,
    json_option,
    print_json,
    robots_option,
    verb,
)


@click.command(name="list")
@click.argument(
    "kind", metavar="robots|payloads|tasks|excitations|estimators|suites|simulations|plants"
)
@robots_option
@json_option
@verb
def list_(kind: str, robots_dir: Path | None, as_json: bool) -> int:
    """List what can be named."""
    from sysid_bench.verbs.catalogue import list_ as entries_of

    entries = entries_of(kind, robots_dir)
    if as_json:
        print_json(entries)
    else:
        width = max((len(entry["name"]) for entry in entries), default=0)
        for entry in entries:
            click.echo(f"{entry['name']:<{width}}  {entry['title']}".rstrip())
    return OK


@click.command()
@click.argument("name")
@robots_option
@json_option
@verb
def show(name: str, robots_dir: Path | None, as_json: bool) -> int:
    """Show one robot, payload, plug-in or suite."""
    from sysid_bench.verbs.catalogue import show as shown

    thing = shown(name, robots_dir)
    if as_json:
        print_json(thing)
    else:
        for key, value in thing.items():
            text = value if isinstance(value, str) else json.dumps(value, default=str)
            click.echo(f"{key:<12} {text}")
    return OK


@click.command(name="check-plugin")
@click.argument("name", metavar="PKG:OBJ")
@robots_option
@json_option
@verb
def check_plugin(name: str, robots_dir: Path | None, as_json: bool) -> int:
    """Run an estimator through its laws.

    Exit code 1 where it breaks one.
    """
    from sysid_bench.verbs import check_plugin as checks

    answer = checks.check_plugin(name, robots_dir)
    if as_json:
        print_json(answer)
    else:
        for line in checks.summary(answer):
            click.echo(line)
    return OK if answer["ok"] else FAILED


@click.command()
@json_option
@verb
def doctor(as_json: bool) -> int:
    """Check this machine."""
    from sysid_bench.verbs.doctor import doctor as examine

    findings = examine()
    if as_json:
        print_json(findings)
    else:
        for check in findings["checks"]:
            word = "ok" if check["ok"] else ("MISSING" if check["needed"] else "absent (optional)")
            click.echo(f"{check['name']:<20} {word:<18} {check['detail']}")
    return OK if findings["ok"] else FAILED
