"""MuJoCo's warnings, recorded instead of printed and logged to a file."""

import warnings
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco

_RECORDED: deque[str] = deque(maxlen=100)


def _install_handler() -> None:
    """Record warnings from now on; a handler that the user has set stays in place."""
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_RECORDED.append)


@contextmanager
def recorded_warnings() -> Iterator[None]:
    """Record, within the context, the warnings that the compiler gives to Python.

    They report mass matrices that are singular at the reference, as with z-x-z hinges on one body:
    not an error by itself.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    _RECORDED.extend(str(warning.message) for warning in caught)


def warnings_from() -> tuple[str, ...]:
    """Return the warnings since the last call, each once."""
    texts = tuple(dict.fromkeys(" ".join(text.split()) for text in _RECORDED))
    _RECORDED.clear()
    return texts


_install_handler()
