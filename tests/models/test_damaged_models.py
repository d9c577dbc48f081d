"""Two hundred files that are no robots: each is refused in one sentence, at once."""

import random
import re
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from sysid_bench import package_folders
from sysid_bench.commands.crosscheck import crosscheck
from sysid_bench.models.random_robot import RandomRobot, random_robot

SEEDS = range(200)
URDFS = (
    "ur_description/urdf/ur5_robot.urdf",
    "so_arm_description/urdf/so101.urdf",
    "solo_description/robots/solo12.urdf",
)
ALWAYS = RandomRobot(welded=0, several=0, shape=0, unnamed=0, free_root=0)
SECRET = "the-secret-that-nobody-asked-for"
QUICK = 10.0  # seconds; the slowest takes a tenth of one


def drawn(text: str, pattern: str, draw: random.Random) -> re.Match[str]:
    return draw.choice(list(re.finditer(pattern, text)))


def replaced(text: str, match: re.Match[str], new: str) -> str:
    return text[: match.start(1)] + new + text[match.end(1) :]


def truncated(text: str, draw: random.Random) -> str:
    return text[: draw.randrange(1, text.rindex("</"))]


def a_mass_below_zero(text: str, draw: random.Random) -> str:
    match = drawn(text, r'<mass\s+value="([^"]+)"|mass="([^"]+)"', draw)
    whole = re.sub(r'"[^"]+"$', f'"-{draw.uniform(0.1, 9):.3f}"', match[0])
    return text[: match.start()] + whole + text[match.end() :]


def no_number(text: str, draw: random.Random) -> str:
    match = drawn(text, r'(?:ixx|<mass\s+value|mass|diaginertia|<axis xyz| axis)="([^"]+)"', draw)
    return replaced(text, match, draw.choice(("nan", "nan nan nan", "inf 0 0", "1e999", "-inf")))


def a_unit(text: str, draw: random.Random) -> str:
    match = drawn(text, r'(?:ixx|<mass\s+value|mass|diaginertia|<axis xyz| axis)="([^"]+)"', draw)
    return replaced(text, match, match[1] + draw.choice((" kg", "mm", " deg", "_m", " N m")))


def a_name_twice(text: str, draw: random.Random) -> str:
    kind = "link" if "<robot" in text else "body"
    names = re.findall(rf'<{kind} name="([^"]+)"', text)
    one, other = draw.sample(sorted(set(names)), 2)
    return text.replace(f'<{kind} name="{one}"', f'<{kind} name="{other}"', 1)


def a_cycle(text: str, draw: random.Random) -> str:
    if "<mujoco" in text:
        return text.replace("<worldbody>", '<include file="robot.xml"/><worldbody>', 1)
    joint = draw.choice(list(re.finditer(r"<joint.*?</joint>", text, re.DOTALL)))
    child = drawn(joint[0], r'<child\s+link="([^"]+)"', draw)[1]
    circle = replaced(joint[0], drawn(joint[0], r'<parent\s+link="([^"]+)"', draw), child)
    return text.replace(joint[0], circle, 1)


def a_bomb(text: str, draw: random.Random) -> str:
    levels = draw.randrange(3, 30)
    entities = '<!ENTITY e0 "boom">' + "".join(
        f'<!ENTITY e{k} "&e{k - 1};&e{k - 1};&e{k - 1};">' for k in range(1, levels)
    )
    root = re.search(r"<(robot|mujoco)\b", text)
    assert root
    head = re.sub(r"<\?xml[^>]*\?>", "", text[: root.start()])
    return f"{head}<!DOCTYPE x [{entities}]>{text[root.start() :]}<!-- &e{levels - 1}; -->"


def a_file_outside(text: str, draw: random.Random) -> str:
    """An XML entity in a URDF, an include in an MJCF."""
    where = draw.choice(("../secret.xml", "./../secret.xml", "{folder}/../secret.xml"))
    if "<robot" in text:
        root = text.index("<robot")
        entity = f'<!DOCTYPE robot [<!ENTITY s SYSTEM "{where}">]>'
        return entity + text[root:].replace("</robot>", "&s;</robot>")
    return text.replace("<worldbody>", f'<include file="{where}"/><worldbody>', 1)


def too_many(text: str, draw: random.Random) -> str:
    if "<robot" in text:
        return text.replace("</robot>", "<a>" * 3000 + "</a>" * 3000 + "</robot>")
    opening = f'<worldbody><replicate count="{draw.choice((10**6, 10**9, 10**12))}">'
    return text.replace("<worldbody>", opening).replace("</worldbody>", "</replicate></worldbody>")


def other_bytes(text: str, draw: random.Random) -> str:
    start = draw.randrange(len(text) // 2)
    return text[:start] + "".join(draw.choice("\0<&\x01]") for _ in range(20)) + text[start:]


WAYS: tuple[Callable[[str, random.Random], str], ...] = (
    truncated, a_mass_below_zero, no_number, a_unit, a_name_twice, a_cycle, a_bomb, a_file_outside,
    too_many, other_bytes,
)  # fmt: skip


def damaged(seed: int, folder: Path) -> Path:
    """A file with the damage of its seed; every way meets every kind of text."""
    draw, way = random.Random(seed), WAYS[seed % len(WAYS)]
    if (seed // len(WAYS)) % 2:
        text, suffix = random_robot(seed, ALWAYS), ".xml"
    else:
        text = (package_folders.robot_data_folder() / draw.choice(URDFS)).read_text(
            encoding="utf-8"
        )
        text = re.sub(r"<!--.*?-->|<(transmission|gazebo).*?</\1>", "", text, flags=re.DOTALL)
        suffix = ".urdf"
    file = folder / f"robot{suffix}"
    file.write_text(way(text, draw).replace("{folder}", str(folder)), encoding="utf-8")
    return file


@pytest.mark.parametrize("seed", SEEDS)
def test_a_damaged_file_is_one_sentence(seed: int, tmp_path: Path) -> None:
    (tmp_path / "secret.xml").write_text(f"<mujoco><{SECRET}/></mujoco>")
    folder = tmp_path / "model"
    folder.mkdir()
    start = time.process_time()
    [verdict] = crosscheck(damaged(seed, folder), samples=2)
    assert time.process_time() - start < QUICK
    reported = verdict["reason"]
    assert not verdict["ok"]
    assert len(reported) > 20
    assert reported.startswith(("robot.", "MuJoCo cannot"))
    assert not re.search(r"\n|Traceback|Error\(", reported)
    assert SECRET not in reported


def test_undamaged_the_same_texts_are_robots(tmp_path: Path) -> None:
    (tmp_path / "r.xml").write_text(random_robot(1, ALWAYS))
    files = [tmp_path / "r.xml", *(package_folders.robot_data_folder() / file for file in URDFS)]
    assert all(verdict["ok"] for verdict in crosscheck(*files, samples=2))
