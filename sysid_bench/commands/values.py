"""Values of options that hold several words; names are checked by the commands themselves."""

import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from sysid_bench.errors import UsageError
from sysid_bench.experiments.spec import NOISE_UNITS
from sysid_bench.input_files import parse_toml, read_text
from sysid_bench.units import check_unit, interval

_STRING = re.compile(r"'[^']*'|\"[^\"]*\"")
_ASSIGNMENT = re.compile(r"(?<![=!<>])=(?!=)")

Table = str | dict[str, Any]
"""A name, or the table that a text in braces holds."""


def parse_names(text: str | None) -> tuple[str, ...]:
    """Split words at commas, each once; () for None."""
    return tuple(dict.fromkeys(word.strip() for word in (text or "").split(",") if word.strip()))


def parse_words(text: str) -> tuple[str, ...]:
    """Words between commas, empty and repeated ones too: the command names what is wrong."""
    return tuple(word.strip() for word in text.split(","))


def check_seed(seed: int) -> None:
    """Raise UsageError for a seed that is not an integer of 0 or more."""
    try:
        # Also integers of NumPy, and not floats.
        valid = seed.__index__() >= 0
    except (AttributeError, TypeError):
        valid = False
    if not valid:
        raise UsageError(f"seed must be an integer of 0 or more, such as 0; got {seed!r}.")


def parse_metrics(text: str | None) -> tuple[str, ...]:
    """Names of metrics; () for None; raise UsageError for a text without any."""
    names = parse_names(text)
    if text is not None and not names:
        raise UsageError(
            f"--metrics {text!r} names no metric; write --metrics rank,torque_error, or leave it "
            "out."
        )
    return names


def parse_terms(text: str | None) -> tuple[str, ...] | None:
    """Joint terms of "viscous,coulomb,j1.k"; () for "none"; None leaves the choice to the robot."""
    words = parse_names(text)
    if text is None:
        return None
    return () if words == ("none",) else words


def _name_or_table(option: str, example: str, text: str) -> Table:
    """A name, or a TOML table in braces; raise UsageError with an example for another text."""
    if not text.lstrip().startswith("{"):
        return text
    try:
        return dict(parse_toml(f"{option} = {text}")[option])
    except ValueError as error:
        raise UsageError(
            f"The {option} {text!r} is not a TOML table ({error}); write --{option} '{example}'."
        ) from error


parse_payload: Callable[[str], Table] = partial(
    _name_or_table, "payload", '{ mass = 1.2, com = [0, 0, 0.05], inertia = "sphere 0.05 m" }'
)
parse_pipeline: Callable[[str], Table] = partial(
    _name_or_table, "pipeline", '{ use = "parallel", cutoff = "6 Hz" }'
)
parse_prior: Callable[[str], Table] = partial(
    _name_or_table, "prior", '{ mass = "10 %", com = "20 mm" }'
)


def parse_noise(text: str | None) -> dict[str, str]:
    """[noise] table of "tau=0.5 %,q=1e-4 rad"; raise UsageError for a key given twice or without
    a value."""
    table: dict[str, str] = {}
    for part in filter(str.strip, (text or "").split(",")):
        key, value = (word.strip() for word in part.partition("=")[::2])
        if not (key and value):
            raise UsageError(
                f"--noise {part.strip()}: a value is missing; write a name and a quantity, as "
                "--noise 'tau=0.5 %,q=1e-4 rad'."
            )
        if key in table:
            raise UsageError(f"--noise has {key} twice.")
        check_unit(f"--noise {key}", value, NOISE_UNITS.get(key, "1"), key == "tau")
        table[key] = value
    return table


def parse_condition(text: str | None) -> str | None:
    """Condition on cells as it was typed; raise UsageError for a single "=" outside strings."""
    # ==, !=, <= and >= are comparisons; what stands in quotes is a label.
    if text is not None and _ASSIGNMENT.search(_STRING.sub("", text)):
        corrected = _ASSIGNMENT.sub("==", text)
        raise UsageError(f"{text!r} compares with a single '='; write ==, as in: {corrected}")
    return text


def parse_contact(text: str) -> list[str] | str:
    """ "detect", or the periods of "10 s to 25 s,40 s to 41 s"; raise UsageError for others."""
    if text == "detect":
        return text
    periods = list(parse_names(text))
    # An empty text is not "no periods": its reading raises the error.
    for period in periods or [text]:
        interval(period)
    return periods


# --- NAME=VALUE ---------------------------------------------------------------------------------


def parse_entries(words: Sequence[str]) -> list[tuple[str, str]]:
    """Pairs of "NAME=VALUE"; raise UsageError for a word without both."""
    pairs = []
    for word in words:
        key, _, value = word.partition("=")
        if not (key.strip() and value):
            raise UsageError(f"{word!r} is not a pair; write NAME=VALUE.")
        pairs.append((key.strip(), value))
    return pairs


def parse_numbers(
    option: str, texts: Sequence[str], example: str = "torque_error=1.05"
) -> dict[str, float]:
    """Numbers of "name=1.5" texts; raise UsageError for a text of another form."""
    numbers = {}
    for text in texts:
        name, _, value = (part.strip() for part in text.partition("="))
        try:
            numbers[name] = float(value)
        except ValueError:
            raise UsageError(
                f"--{option} {text!r} is not a name and a number without unit; "
                f"write --{option} {example}."
            ) from None
    return numbers


def parse_criterion(text: str) -> str | dict[str, float]:
    """Name of an objective, or the weights of "D=1,cond=0.2"."""
    if "=" not in text:
        return text
    return {name: _number(value) for name, value in parse_entries(text.split(","))}


def parse_limits(words: Sequence[str]) -> dict[str, list[float]]:
    """Numbers of "v=1.7,1.7,2.2", by the key."""
    return {key: [_number(x) for x in values.split(",")] for key, values in parse_entries(words)}


def parse_boxes(words: Sequence[str]) -> dict[str, list[list[float]]]:
    """Ranges (m) of "BODY=x:x,y:y,z:z", by the body."""
    boxes = {}
    for body, text in parse_entries(words):
        ranges = [part.split(":") for part in text.split(",")]
        if [len(part) for part in ranges] != [2, 2, 2]:
            raise UsageError(f"The box of {body!r} is written x:x,y:y,z:z in m; got {text!r}.")
        boxes[body] = [[_number(end) for end in part] for part in ranges]
    return boxes


def parse_motors(text: str) -> dict[str, dict[str, Any]]:
    """Motors of "DM4340,DM4310", in the order of the moving joints ("1", "2", ...), or of a TOML
    file with a table for each joint, and [all]."""
    if not text.endswith(".toml"):
        return {str(k): {"motor": name.strip()} for k, name in enumerate(text.split(","), 1)}
    try:
        table = parse_toml(read_text(Path(text)))
    except FileNotFoundError as error:
        raise UsageError(f"The file {text!r} of motors does not exist.") from error
    except OSError as error:
        raise UsageError(f"{text} cannot be read: {error.strerror or error}.") from error
    except ValueError as error:
        raise UsageError(f"{text}: {error}.") from error
    if not (table and all(isinstance(value, dict) for value in table.values())):
        raise UsageError(f"{text}: write a table for each joint: [joint1] motor = 'DM4340'.")
    return table


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise UsageError(f"{text!r} is not a number.") from error
