"""Data sets of the tests: a folder with a robot, recordings and dataset.toml; a server of files."""

import hashlib
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote

import mujoco
import numpy as np
import pytest

ARM = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="upper">
      <joint name="j1" axis="0 1 0" range="-6 6"/>
      <inertial pos="0 0 -0.1" mass="0.7" diaginertia="0.004 0.004 0.001"/>
      <body name="lower" pos="0 0 -0.3">
        <joint name="j2" axis="0 1 0" range="-6 6"/>
        <inertial pos="0.01 0 -0.08" mass="0.4" diaginertia="0.002 0.002 0.001"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
SET = """
name    = "mine"
title   = "Two links on a table"
origin  = "github.com/me/mine"
licence = "MIT"
train   = ["monday"]
test    = ["tuesday"]
split   = "another day"
[robot]
file  = "arm.xml"
terms = ["viscous", "coulomb"]
[log]
rate   = "200 Hz"
joints = ["j1", "j2"]
q      = { columns = [1, 2] }
tau    = { columns = [3, 4] }
[motions.monday]
file = "monday.csv"
rows = [1, 2000]
[motions.tuesday]
file = "tuesday.csv"
rows = [1, 2000]
"""


def recorded(seed: int) -> np.ndarray:
    """Positions and torques (2000, 4) of the arm on a Fourier motion, noise of 1 %."""
    random = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    t = np.arange(2000) / 200
    w = 2 * np.pi * np.arange(1, 5) * 0.2
    amplitude, phase = random.uniform(0.2, 0.5, (2, 4)), random.uniform(0, 6, (2, 4))
    waves = w[None, None] * t[:, None, None] + phase
    q = (amplitude * np.sin(waves)).sum(axis=2)
    v = (amplitude * w * np.cos(waves)).sum(axis=2)
    a = -(amplitude * w**2 * np.sin(waves)).sum(axis=2)
    tau = np.empty_like(q)
    for k in range(len(t)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], v[k], a[k]
        mujoco.mj_inverse(model, data)
        tau[k] = data.qfrc_inverse
    tau += 0.05 * v + 0.05 * np.sign(v)
    return np.hstack([q, tau + 0.01 * tau.std(axis=0) * random.standard_normal(tau.shape)])


@pytest.fixture(scope="session")
def recordings() -> dict[str, np.ndarray]:
    """The two recordings of the arm."""
    return {"monday": recorded(1), "tuesday": recorded(2)}


@pytest.fixture
def own_set(tmp_path: Path, recordings: dict[str, np.ndarray]) -> Path:
    """A folder with a robot, logs and dataset.toml."""
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "arm.xml").write_text(ARM)
    (folder / "dataset.toml").write_text(SET)
    for name, values in recordings.items():
        np.savetxt(folder / f"{name}.csv", values, delimiter=",", fmt="%.9g")
    return folder


@pytest.fixture(autouse=True)
def _no_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No mirror, and an empty cache."""
    monkeypatch.delenv("SYSID_BENCH_DATA", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@dataclass
class Server:
    """What a server of files has, how it fails, and what it was asked for."""

    url: str = ""
    files: dict[str, bytes] = field(default_factory=dict)
    cut: set[str] = field(default_factory=set)  # files whose connection ends half way
    asked: list[str] = field(default_factory=list)


@pytest.fixture
def server() -> Iterator[Server]:
    """A server on this machine."""
    state = Server()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            name = unquote(self.path.strip("/"))
            state.asked.append(name)
            if name not in state.files:
                self.send_error(404)
                return
            content = state.files[name]
            self.send_response(200)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            with suppress(ConnectionError):  # of one who reads no further
                self.wfile.write(content[: len(content) // 2] if name in state.cut else content)

        def log_message(self, format: str, *args: object) -> None:
            """Print nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as listening:
        thread = threading.Thread(target=listening.serve_forever, daemon=True)
        thread.start()
        state.url = f"http://127.0.0.1:{listening.server_address[1]}"
        yield state
        listening.shutdown()
        thread.join()


@dataclass(frozen=True)
class Remote:
    """A data set whose files are on the server alone: its description, and their contents."""

    file: Path
    contents: dict[str, bytes]

    def change(self, old: str, new: str) -> None:
        """Replace a text of the description."""
        text = self.file.read_text()
        assert old in text
        self.file.write_text(text.replace(old, new))


@pytest.fixture
def remote(tmp_path: Path, server: Server) -> Remote:
    """A data set of two files on the server."""
    folder = tmp_path / "remote"
    folder.mkdir()
    contents = {"runs/a.csv": b"1,2\n" * 5000, "runs/b.csv": b"3,4\n" * 7000}
    server.files.update({Path(path).name: content for path, content in contents.items()})
    text = SET.replace("[robot]", f'url = "{server.url}"\n[robot]')
    for path, content in contents.items():
        digest = hashlib.sha256(content).hexdigest()
        text += (
            f'[[file]]\npath = "{path}"\norigin = "{Path(path).name}"\n'
            f'bytes = {len(content)}\nsha256 = "{digest}"\n'
        )
    (folder / "dataset.toml").write_text(text)
    return Remote(folder / "dataset.toml", contents)
