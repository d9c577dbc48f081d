"""Words of an option that holds several."""

from collections.abc import Sequence
from typing import Any

from sysid_bench.errors import UsageError, unknown_name


def parse_terms(text: str | None) -> tuple[str, ...] | None:
    """Joint terms of "viscous,coulomb,j1.k"; "none" is no term, and None leaves the choice to the
    robot.

    Raises UsageError with the nearest word.
    """
    from sysid_bench.models.manifest import TERM_ADVICE, TERMS, is_term

    if text is None:
        return None
    words = tuple(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))
    if words in ((), ("none",)):
        return ()
    for word in words:
        if not is_term(word):
            advice = f"{TERM_ADVICE} Separate several by commas, or: none."
            raise unknown_name("joint term", word, TERMS, advice)
    return words


def refuse_ignored_terms(task: str, terms: Sequence[str] | None) -> None:
    """Raises UsageError for joint terms that are asked of a task where they are known."""
    from sysid_bench.tasks.task import named_task, tasks_with_terms

    if terms and not named_task(task).accepts_terms:
        raise UsageError(
            f"The task {task!r} takes joint terms as known, so {', '.join(terms)} cannot be "
            "identified with it; leave --terms out, or take the task "
            f"{' or '.join(tasks_with_terms())}."
        )


def parse_payload_option(text: str) -> str | dict[str, Any]:
    """A payload's name, or the table that a text in braces holds, as TOML writes it."""
    import tomllib

    if not text.lstrip().startswith("{"):
        return text
    try:
        return dict(tomllib.loads(f"payload = {text}")["payload"])
    except tomllib.TOMLDecodeError as error:
        raise UsageError(
            f"The payload {text!r} is no TOML table ({error}); write --payload "
            "'{ mass = 1.2, com = [0, 0, 0.05], inertia = \"sphere 0.05 m\" }'."
        ) from error


def parse_noise(text: str | None) -> dict[str, str]:
    """The [noise] table of "tau=0.5 %,q=1e-4 rad". Raises UsageError for another key."""
    from sysid_bench.experiments.spec import NOISE_UNITS

    table: dict[str, str] = {}
    for part in (text or "").split(","):
        key, _, value = part.partition("=")
        if not part.strip():
            continue
        if key.strip() not in NOISE_UNITS:
            raise unknown_name("noise", key.strip(), NOISE_UNITS, "Write q=1e-4 rad,tau=0.5 %.")
        if key.strip() in table:
            raise UsageError(f"--noise has {key.strip()} twice.")
        table[key.strip()] = value.strip()
    return table


def parse_contacts(text: str | None) -> list[str] | str | None:
    """ "detect", or the periods of "10 s to 25 s,40 s to 41 s"; raises UsageError for others."""
    from sysid_bench.units import interval

    if text is None or text == "detect":
        return text
    periods = [part.strip() for part in text.split(",") if part.strip()]
    for period in periods or [text]:
        interval(period)
    return periods
