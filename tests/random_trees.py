"""Hypothesis strategies over the package's own random robots."""

from hypothesis import strategies as st

from sysid_bench.models.random_robot import RandomRobot, random_robot

SHARE = st.sampled_from([0.0, 0.3, 1.0])


def settings_of_random_robots(most: int = 8) -> st.SearchStrategy[RandomRobot]:
    """Any settings of trees with up to `most` bodies; what is simplest comes first."""
    return st.builds(
        RandomRobot,
        bodies=st.tuples(st.just(1), st.integers(1, most)),
        roots=st.tuples(st.just(1), st.integers(1, 3)),
        branch=SHARE,
        free_root=SHARE,
        welded=SHARE,
        several=SHARE,
        ball=SHARE,
        slide=SHARE,
        anchored=SHARE,
        tilted=SHARE,
        reference=SHARE,
        unnamed=SHARE,
        shape=SHARE,
        any_gravity=SHARE,
        no_gravity=SHARE,
    )


def random_texts(most: int = 8) -> st.SearchStrategy[str]:
    """MJCF texts of random trees."""
    seeds = st.integers(0, 2**32 - 1)
    return st.builds(random_robot, seeds, settings_of_random_robots(most))
