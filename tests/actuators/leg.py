"""A leg of three joints with known actuators, and recordings of it under position control."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import mujoco
import numpy as np

from sysid_bench.apps.actuators.drive_rows import joint_indices
from sysid_bench.apps.actuators.rollout import Drives, drive_model, positions_of
from sysid_bench.models.load import load_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.signals.filter import filter_of
from sysid_bench.signals.log import Log, read_log
from sysid_bench.signals.log_data import log_of
from sysid_bench.signals.position_control import Commands
from sysid_bench.types import Array

JOINTS = ("hip", "thigh", "calf")
RATE = 200.0
FINE = 1e-3
"""s, of the plant's steps of RK4: an implicit one acts like an armature of damping times it."""

MODEL = """<mujoco>
  <compiler autolimits="true"/>
  <worldbody>
    <body name="trunk_side">
      <inertial pos="0 .03 0" mass=".7" diaginertia=".001 .001 .001"/>
      <joint name="hip" axis="1 0 0" armature=".5"/>
      <body name="upper" pos="0 .1 0">
        <inertial pos="0 .02 -.03" mass="1.1" diaginertia=".006 .006 .001"/>
        <joint name="thigh" axis="0 1 0"/>
        <body name="lower" pos="0 0 -.21">
          <inertial pos=".006 0 -.14" mass=".25" diaginertia=".0015 .0015 .0001"/>
          <joint name="calf" axis="0 1 0"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="drive" joint="thigh" gear="3"/>
  </actuator>
  <sensor><actuatorfrc actuator="drive"/></sensor>
</mujoco>
"""


@cache
def leg(joint: str = "") -> RobotModel:
    """The robot, from a file of its own, with attributes of its calf `joint`."""
    file = Path(mkdtemp()) / "leg.xml"
    calf = '<joint name="calf" '
    file.write_text(MODEL.replace(calf, calf + joint), encoding="utf-8")
    return load_robot(file)


@dataclass(frozen=True)
class Case:
    """A recording: `gains` are the shares of kp and kd in equal parts of its time, `disturbance`
    (N m) is the RMS of a random torque below 10 Hz that no fit knows of; the commands of a `still`
    one are constant; `joint` holds attributes of the calf, `more` further true values of the
    actuators, alike in all joints."""

    seed: int
    delay: float
    gains: Sequence[tuple[float, float]] = ((1.0, 1.0), (0.5, 0.5))
    noise: float = 5e-5
    seconds: float = 12.0
    kp: float = 30.0
    kd: float = 0.8
    smooth: bool = False
    disturbance: float = 0.1
    still: bool = False
    joint: str = ""
    more: tuple[tuple[str, float], ...] = ()

    @property
    def drives(self) -> Drives:
        """The true actuators."""
        more = {name: np.full(len(JOINTS), value) for name, value in self.more}
        return Drives(JOINTS, self.values, self.delay, more)

    @property
    def values(self) -> Array:
        """True values (3, 4)."""
        rng = np.random.default_rng(self.seed)
        low, high = [0.005, 0.05, 0.05, -0.3], [0.04, 0.2, 0.4, 0.3]
        return rng.uniform(low, high, (len(JOINTS), 4))

    def log(self, **pd: object) -> Log:
        """The recording as a log; `pd` replaces settings of its controller."""
        commands = self.commands()
        controller = {"q_des": "q_des", "kp": "kp", "kd": "kd", "delay": "profile", **pd}
        data = {"q": commands.q, "q_des": commands.q_des, "kp": commands.kp, "kd": commands.kd}
        keys = {"joints": list(JOINTS), "rate": RATE, "tau": {"pd": controller}}
        return read_log(log_of(data, keys), leg(self.joint))

    def commands(self) -> Commands:
        """State and commands of the plant."""
        rng = np.random.default_rng([self.seed, 1])
        n, k = int(self.seconds * RATE), len(JOINTS)
        zeros, part = np.zeros((n, k)), np.arange(n) * len(self.gains) // n
        kp, kd = (
            np.tile(gain * np.array([share[i] for share in self.gains])[part][:, None], (1, k))
            for i, gain in enumerate((self.kp, self.kd))
        )
        commands = Commands(
            joints=JOINTS, rate=RATE, q=zeros, v=None, q_des=self._wanted(rng, n), v_des=zeros,
            feedforward=zeros, kp=kp, kd=kd, limit=np.full(k, np.inf), delay=None,
        )  # fmt: skip
        return self.moved(commands, rng)

    def moved(self, commands: Commands, rng: np.random.Generator) -> Commands:
        """Commands with the positions under them: the plant is simulated with steps of FINE and
        stiff friction."""
        n = len(commands)
        drives, robot = self.drives, leg(self.joint)
        acting = drives.apply(commands)
        mj = drive_model(robot, drives, acting)
        mj.opt.timestep, mj.opt.integrator = FINE, int(mujoco.mjtIntegrator.mjINT_RK4)
        mj.dof_solref[:] = [0.002, 1.0]
        mj.dof_solimp[:] = [0.99, 0.9999, 0.001, 0.5, 2.0]
        places = joint_indices(robot, JOINTS)
        moved = replace(acting, feedforward=self._disturbance(rng, n))
        q = positions_of(mj, places, self.delay, moved, slice(0, n), drives.more.get("load"))
        q = q - drives.more.get("bias", 0.0) + self.noise * rng.normal(size=q.shape)
        return replace(commands, q=q)

    def _disturbance(self, rng: np.random.Generator, n: int) -> Array:
        white = rng.normal(size=(n, len(JOINTS)))
        slow = filter_of("butter 2 10 Hz zero-phase").smooth(white, RATE)
        return np.asarray(self.disturbance * slow / slow.std(axis=0))

    def _wanted(self, rng: np.random.Generator, n: int) -> Array:
        """Chirps with steps, slow sweeps alone, or one position."""
        if self.still:
            return np.tile(rng.uniform(0.2, 0.4, len(JOINTS)), (n, 1))
        t = np.arange(n)[:, None] / RATE
        start, phase = rng.uniform(0.2, 0.4, len(JOINTS)), rng.uniform(0.0, 6.3, len(JOINTS))
        if self.smooth:
            return np.asarray(0.4 * np.sin(2.0 * np.pi * start * t + phase))
        speed = rng.uniform(2.0, 3.5, len(JOINTS))
        chirp = np.sin(2.0 * np.pi * (start + 0.5 * speed * t / t[-1]) * t + phase)
        return np.asarray(0.25 * chirp + 0.15 * np.sign(np.sin(2.0 * np.pi * 0.4 * t + phase)))
