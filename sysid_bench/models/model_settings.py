"""Settings of a robot after its source: "arm.xml?tool=hand&free_base=true".

They stand for keys of a robot.toml, and every verb and suite takes them where it takes a name
or a file.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final
from urllib.parse import parse_qsl, urlencode

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.input_files import is_file, is_folder

SEPARATOR: Final = "?"


def _flag(text: str) -> bool:
    if text not in ("true", "false"):
        raise UsageError(f"free_base = {text!r}: give true or false.")
    return text == "true"


def _folder(text: str) -> Path:
    if not Path(text).is_dir():
        raise UsageError(f"assets: {text!r} is not a folder.")
    return Path(text)


_READ: Final[Mapping[str, Callable[[str], Any]]] = {
    "assets": _folder,
    "tool": str,
    "free_base": _flag,
}


def with_settings(source: str, settings: Mapping[str, Any]) -> str:
    """Return a source with settings after it, those that are None left out; settings that the
    source has already stay unless they are given anew."""
    plain, old = _divided(source)
    texts = {key: _text(value) for key, value in settings.items() if value is not None}
    given = old | texts
    return f"{plain}{SEPARATOR}{urlencode(given)}" if given else source


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return str(value.resolve()) if isinstance(value, Path) else str(value)


def source_settings(source: str) -> tuple[str, dict[str, Any]]:
    """Return a source without its settings, and their values; raise UsageError for a setting that
    there is not, or a value that cannot be used."""
    plain, texts = _divided(source)
    for key in texts:
        if key not in _READ:
            raise unknown_name(f"setting of {plain}", key, _READ)
    return plain, {key: _READ[key](text) for key, text in texts.items()}


def _divided(source: str) -> tuple[str, dict[str, str]]:
    plain, separator, text = source.partition(SEPARATOR)
    if not separator or is_file(Path(source)) or is_folder(Path(source)):
        return source, {}
    return plain, dict(parse_qsl(text, keep_blank_values=True))
