"""Values of options that hold several words; names are checked by the commands themselves."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sysid_bench.errors import UsageError

_UNITS = {"period": "s", "clearance": "m", "floor": "m", "torque_share": "1"}


def parse_names(text: str | None) -> tuple[str, ...]:
    """Split words at commas, each once; () for None."""
    return tuple(dict.fromkeys(word.strip() for word in (text or "").split(",") if word.strip()))


def parse_terms(text: str | None) -> tuple[str, ...] | None:
    """Joint terms of "viscous,coulomb,j1.k"; () for "none"; None leaves the choice to the robot."""
    words = parse_names(text)
    if text is None:
        return None
    return () if words == ("none",) else words


def parse_payload(text: str) -> str | dict[str, Any]:
    """Name of a payload, or the TOML table that a text in braces holds."""
    if not text.lstrip().startswith("{"):
        return text
    try:
        return dict(_toml(f"payload = {text}")["payload"])
    except ValueError as error:
        raise UsageError(
            f"The payload {text!r} is not a TOML table ({error}); write --payload "
            "'{ mass = 1.2, com = [0, 0, 0.05], inertia = \"sphere 0.05 m\" }'."
        ) from error


def parse_noise(text: str | None) -> dict[str, str]:
    """[noise] table of "tau=0.5 %,q=1e-4 rad"; raise UsageError for a key given twice."""
    table: dict[str, str] = {}
    for part in (text or "").split(","):
        key, _, value = part.partition("=")
        if not part.strip():
            continue
        if key.strip() in table:
            raise UsageError(f"--noise has {key.strip()} twice.")
        table[key.strip()] = value.strip()
    return table


def parse_contacts(text: str | None) -> list[str] | str | None:
    """ "detect", or the periods of "10 s to 25 s,40 s to 41 s"; raise UsageError for others."""
    from sysid_bench.units import interval

    if text is None or text == "detect":
        return text
    periods = list(parse_names(text))
    for period in periods or [text]:
        interval(period)
    return periods


def parse_objective(text: str) -> str | dict[str, float]:
    """Name of an objective, or the weights of "D=1,cond=0.2"."""
    if "=" not in text:
        return text
    return {name: _number(value) for name, value in parse_pairs(text.split(","))}


def parse_limits(words: Sequence[str]) -> dict[str, list[float]]:
    """Numbers of "v=1.7,1.7,2.2", by the key."""
    return {key: [_number(x) for x in values.split(",")] for key, values in parse_pairs(words)}


def parse_settings(options: Mapping[str, Any], boxes: Sequence[str]) -> dict[str, Any]:
    """Settings of the excitation `optimised` in SI units; options that are None are left out."""
    from sysid_bench.units import quantity

    settings: dict[str, Any] = {
        key: quantity(value, _UNITS[key]) if key in _UNITS else value
        for key, value in options.items()
        if value is not None
    }
    if "joints" in settings:
        settings["joints"] = tuple(name.strip() for name in settings["joints"].split(","))
    if boxes:
        settings["boxes"] = {body: _box(body, ranges) for body, ranges in parse_pairs(boxes)}
    return settings


def parse_motors(text: str) -> dict[str, dict[str, Any]]:
    """Motors of "DM4340,DM4310", in the order of the moving joints ("1", "2", ...), or of a TOML
    file with a table for each joint, and [all]."""
    if not text.endswith(".toml"):
        return {str(k): {"motor": name.strip()} for k, name in enumerate(text.split(","), 1)}
    try:
        table = _toml(Path(text).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise UsageError(f"There is no file {text!r} of motors.") from error
    except ValueError as error:
        raise UsageError(f"{text}: {error}.") from error
    if not all(isinstance(value, dict) for value in table.values()):
        raise UsageError(f"{text}: write a table for each joint: [joint1] motor = 'DM4340'.")
    return table


def parse_pairs(words: Sequence[str]) -> list[tuple[str, str]]:
    """Pairs of "NAME=VALUE"; raise UsageError for a word without both."""
    pairs = [word.partition("=") for word in words]
    for key, sign, value in pairs:
        if not (key.strip() and sign and value):
            raise UsageError(f"{key + sign + value!r} is not a pair; write NAME=VALUE.")
    return [(key.strip(), value) for key, _, value in pairs]


def _toml(text: str) -> dict[str, Any]:
    """Tables of a TOML text; raise ValueError (TOMLDecodeError) for another text."""
    import tomllib

    return tomllib.loads(text)


def _box(body: str, text: str) -> list[list[float]]:
    ranges = [part.split(":") for part in text.split(",")]
    if [len(part) for part in ranges] != [2, 2, 2]:
        raise UsageError(f"The box of {body!r} is written x:x,y:y,z:z in m; got {text!r}.")
    return [[_number(low), _number(high)] for low, high in ranges]


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise UsageError(f"{text!r} is not a number.") from error
