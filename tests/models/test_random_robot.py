"""Random robots: possible, the same twice, everything that is promised met, both engines agree."""

import re
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings

from sysid_bench.errors import UsageError
from sysid_bench.evaluation.crosscheck import crosscheck
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.random_robot import (
    MECHANISMS,
    RandomRobot,
    random_coupled_robot,
    random_robot,
)
from sysid_bench.spatial import feasible_margins
from tests.random_trees import random_texts
from tests.robots import robot_of

MANY = range(60)


@settings(max_examples=60)
@given(text=random_texts())
def test_two_engines_agree_on_any_settings(text: str) -> None:
    robot = robot_of(text)
    scale = np.maximum(np.abs(robot.phi).max(axis=1), 1e-300)
    assert (feasible_margins(robot.phi) >= -1e-9 * scale).all()
    check = crosscheck(robot, 8)
    assert check.gap <= 1e-12
    assert check.closure <= 1e-11


REST = pytest.param(range(60, 500), marks=pytest.mark.long)


@pytest.mark.parametrize("seeds", [range(60), REST], ids=["first", "rest"])
def test_five_hundred_seeds_agree(seeds: range) -> None:
    worst = [0.0, 0.0]
    for seed in seeds:
        check = crosscheck(load_robot(f"random:{seed}"), 3)
        assert check.gap <= 1e-12, seed
        assert check.closure <= 1e-11, seed
        worst = [max(worst[0], check.gap), max(worst[1], check.closure)]
    assert min(worst) > 0


def test_a_seed_is_one_robot() -> None:
    assert random_robot(7) == random_robot(7) == find_manifest("random:7").text
    assert len({random_robot(seed) for seed in MANY}) == len(MANY)


def test_everything_that_is_promised_is_met() -> None:
    texts = [random_robot(seed) for seed in MANY]
    everything = " ".join(texts)
    kinds = Counter(re.findall(r'type="(hinge|slide|ball|free)"', everything))
    assert set(kinds) == {"hinge", "slide", "ball", "free"}
    words = ("ref=", "springref=", "armature=", "damping=", "frictionloss=", "range=", "<geom")
    assert all(word in everything for word in (*words, 'gravity="disable"'))
    robots = [load_robot(f"random:{seed}") for seed in MANY]
    assert any(sum(not link.parent + 1 for link in r.tree.links) > 1 for r in robots)  # roots
    assert any(r.mj.body_jntnum.max() > 1 for r in robots)
    assert any((r.tree.carrier >= 0).sum() > len(r.tree.links) for r in robots)  # welded
    assert any(np.abs(r.mj.jnt_pos).max() > 0 for r in robots)
    assert any(not r.tree.gravity.any() for r in robots)


@pytest.mark.parametrize("seed", MANY)
def test_settings_hold(seed: int) -> None:
    plain = RandomRobot((4, 4), (1, 1), free_root=0, welded=0, several=0, ball=0, slide=0)
    robot = robot_of(random_robot(seed, plain))
    assert [joint.kind for joint in robot.joints] == ["hinge"] * 4
    welded = robot_of(random_robot(seed, RandomRobot(welded=1, free_root=0)))
    assert welded.nv == 1  # something has to move


@pytest.mark.parametrize(
    "wrong", [{"bodies": (0, 3)}, {"bodies": (5, 3)}, {"slide": 1.5}, {"slide": float("nan")}]
)
def test_settings_that_make_no_robot_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(UsageError, match=next(iter(wrong))):
        RandomRobot(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("source", ["random:", "random:x", "random:-1", "random:1.5", "random:٣"])
def test_a_seed_is_a_whole_number(source: str) -> None:
    with pytest.raises(UsageError, match="whole number"):
        find_manifest(source)


@pytest.mark.parametrize("kind", MECHANISMS)
def test_a_kind_and_a_seed_are_one_mechanism(kind: str) -> None:
    assert random_coupled_robot(kind, 7) == find_manifest(f"random:{kind}:7").text
    assert len({random_coupled_robot(kind, seed) for seed in MANY}) == len(MANY)


def test_a_wrong_kind_or_seed_of_mechanism_is_reported() -> None:
    with pytest.raises(UsageError, match=r"'fourbar'.*Did you mean 'four-bar'.*slider-crank"):
        find_manifest("random:fourbar:7")
    with pytest.raises(UsageError, match="'random:four-bar:7'"):
        find_manifest("random:four-bar:x")
