"""A damaged file either still is a robot or is refused in one sentence: never another exception."""

import random
import re
from pathlib import Path

import numpy as np
import pytest

from sysid_bench import package_folders
from sysid_bench.errors import SysidBenchError
from sysid_bench.models.load import load_robot
from tests.robots import random_mjcf

FILES = ("ur_description/urdf/ur5_robot.urdf", "panda_description/urdf/panda.urdf")
WAYS = ("truncate", "attribute", "tag", "number", "value", "line", "repeat", "byte")
JUNK = ("nan", "inf", "-inf", "1e999", "-1e400", "", "0", "-1", "1e300", "abc", "0x10", "1,5", "½")


def damaged(text: str, seed: int) -> str:
    """The text with one wound, drawn by the seed; the ways take turns."""
    draw = random.Random(seed)
    way = WAYS[seed % len(WAYS)]
    if way == "truncate":
        return text[: draw.randrange(len(text))]
    if way == "attribute":
        return _without(text, draw.choice(list(re.finditer(r' \w+="[^"]*"', text))))
    if way == "tag":
        return _with_swapped_tags(text, draw)
    if way == "number":
        match = draw.choice(list(re.finditer(r"(?<=[\" ])-?\d+\.?\d*(e-?\d+)?(?=[\" ])", text)))
        return text[: match.start()] + draw.choice(JUNK) + text[match.end() :]
    if way == "value":
        match = draw.choice(list(re.finditer(r'(?<==")[^"]*(?=")', text)))
        return text[: match.start()] + draw.choice(JUNK) + text[match.end() :]
    lines = text.splitlines()
    at = draw.randrange(len(lines))
    if way == "line":
        del lines[at]
    elif way == "repeat":
        lines.insert(at, lines[at])
    else:
        lines[at] = lines[at].replace("e", draw.choice(("\x00", "&", "<", ">", "é")), 1)
    return "\n".join(lines)


def _without(text: str, match: re.Match[str]) -> str:
    return text[: match.start()] + text[match.end() :]


def _with_swapped_tags(text: str, draw: random.Random) -> str:
    names = sorted(set(re.findall(r"<(\w+)", text)))
    one, other = draw.sample(names, 2)
    swap = {one: other, other: one}
    pattern = rf"(</?)({one}|{other})(?=[\s/>])"
    return re.sub(pattern, lambda match: match[1] + swap[match[2]], text)


def survives_or_says_why(text: str, suffix: str, folder: Path) -> bool:
    """True where the file loads; a refusal must be one sentence or two on one line, in words."""
    file = folder / f"damaged{suffix}"
    file.write_text(text, encoding="utf-8")
    try:
        robot = load_robot(file)
    except SysidBenchError as error:
        message = str(error)
        assert message.strip()
        assert "\n" not in message
        assert "Traceback" not in message
        return False
    assert np.isfinite(robot.phi).all()
    assert len(set(robot.inertial_columns)) == len(robot.inertial_columns)
    return True


@pytest.mark.parametrize("file", FILES)
def test_a_damaged_urdf_loads_or_is_refused(file: str, tmp_path: Path) -> None:
    text = (package_folders.robot_data_folder() / file).read_text(encoding="utf-8")
    assert survives_or_says_why(text, ".urdf", tmp_path)
    loaded = [survives_or_says_why(damaged(text, seed), ".urdf", tmp_path) for seed in range(100)]
    assert any(loaded)
    assert not all(loaded)


def test_a_damaged_mjcf_loads_or_is_refused(tmp_path: Path) -> None:
    loaded = []
    for seed in range(100):
        text = random_mjcf(seed, bodies=4).replace("><", ">\n<")
        loaded.append(survives_or_says_why(damaged(text, seed), ".xml", tmp_path))
    assert any(loaded)
    assert not all(loaded)
