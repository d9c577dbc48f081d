"""Words of joint features among those of joint terms: columns that only recordings have."""

from collections.abc import Sequence

from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.plugin_names import known
from sysid_bench.words import MOTOR


def words_of_features(words: Sequence[str], robot: RobotModel) -> tuple[str, ...]:
    """Return those words that name features: of all joints ("tanh"), of one joint ("j2.poly",
    "j2.file:mine.py:Spring") or of motors ("motor.play"), not joint terms ("viscous", "j2.k")."""
    return tuple(word for word in words if word not in SUFFIX and _is_feature(word, robot))


def _is_feature(word: str, robot: RobotModel) -> bool:
    if word.startswith(f"{MOTOR}."):
        return True
    joint = joint_of(word, robot.rows)
    name = word.removeprefix(f"{joint}.") if joint else word
    return word not in robot.term_names and (":" in name or name in known("term"))


def joint_of(word: str, rows: Sequence[str]) -> str:
    """Return the joint that a word begins with, empty where there is none; the longest, since names
    may contain dots."""
    return max((row for row in rows if word.startswith(f"{row}.")), key=len, default="")
