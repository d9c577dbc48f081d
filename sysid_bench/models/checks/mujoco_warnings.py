"""MuJoCo's warnings, kept for whoever asks instead of printed and logged to a file."""

import warnings
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco

_HEARD: deque[str] = deque(maxlen=100)


def capture_warnings() -> None:
    """From now on warnings are kept; a handler that the user has set stays in place."""
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_HEARD.append)


@contextmanager
def captured_warnings() -> Iterator[None]:
    """Within, the warnings that the compiler gives to Python are kept with the others. They speak
    of mass matrices singular at the reference, as those of z-x-z hinges on one body are: no fault
    by itself."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        yield
    _HEARD.extend(str(warning.message) for warning in told)


def warnings_from() -> tuple[str, ...]:
    """The warnings since the last call, each once."""
    texts = tuple(dict.fromkeys(" ".join(text.split()) for text in _HEARD))
    _HEARD.clear()
    return texts


capture_warnings()
