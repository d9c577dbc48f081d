"""The setting `limits` of an excitation: what becomes of a motion that breaks a joint limit.

{ use = "file", file = "replay.csv", limits = "mark" } keeps its rows, and marks them by the row
field `limits_broken`; "refuse", the default, makes them fail. The plug-in never sees the setting.
"""

from collections.abc import Mapping
from typing import Any, Final

from sysid_bench.errors import unknown_name

KEY: Final = "limits"
RULES: Final = ("refuse", "mark")


def checks_limits(excitation: Mapping[str, Any]) -> bool:
    """Return True where a motion beyond a limit fails, False where its rows are marked; raises
    UsageError for another word than those of RULES."""
    written = excitation.get(KEY, RULES[0])
    if written not in RULES:
        raise unknown_name("rule for limits of motions", str(written), RULES)
    return bool(written == "refuse")


def without_limits(excitation: Mapping[str, Any]) -> dict[str, Any]:
    """Return {use, settings} as the plug-in is given them."""
    return {key: value for key, value in excitation.items() if key != KEY}
