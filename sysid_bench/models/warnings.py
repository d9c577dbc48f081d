"""MuJoCo's warnings, kept for whoever asks instead of printed and logged to a file."""

from collections import deque

import mujoco

_HEARD: deque[str] = deque(maxlen=100)


def listen() -> None:
    """From now on warnings are kept; a handler that the user has set stays in place."""
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_HEARD.append)


def heard() -> tuple[str, ...]:
    """The warnings since the last call, each once."""
    texts = tuple(dict.fromkeys(" ".join(text.split()) for text in _HEARD))
    _HEARD.clear()
    return texts


listen()
