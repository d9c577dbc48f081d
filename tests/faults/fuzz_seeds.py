"""Sound inputs that the fuzzer damages; each uses most keys of its kind."""

SUITE = """schema = 1
name   = "fuzzed"
title  = "A suite"
seed   = 7
[run]
timeout = "60 s"
memory = "1.5 GB"
[defaults]
task       = ["robot", "payload"]
terms      = [["viscous"], ["coulomb", "j1.k"]]
plant      = { use = "stribeck" }
excitation = [{ use = "fourier", harmonics = 3, period = "2 s", cycles = 2 }]
held_out   = ["fourier-other", "ptp"]
simulation = { use = "closed-loop", rate = "500 Hz" }
rate       = "100 Hz"
noise      = [{}, { q = "1e-5 rad", tau = "0.5 %" }]
prior      = { mass = "20 %", com = "15 mm", inertia = "30 %" }
signals    = { filter = "butter 4 20 Hz zero-phase", derivatives = "from q", torque = "raw" }
[[robot]]
use      = ["scara", "example-robot-data:ur_description/urdf/ur3_robot.urdf"]
payloads = ["none", { mass = 1.2, com = [0, 0, 0.05], inertia = "sphere 0.05 m", name = "p" }]
[[estimator]]
use = "ols"
[[estimator]]
use = "ridge"
label = "small ridge"
[[exclude]]
when   = 'task == "payload" and payload == "none"'
reason = "no payload to identify"
[crosscheck]
tolerance = 1e-12
[[table]]
name    = "main"
title   = "Held-out torque error"
rows    = ["robot", "payload"]
columns = ["noise", "estimator"]
cells   = { metric = "torque_error", stat = "median", interval = "iqr" }
best    = "min-bold"
select  = 'task == "robot"'
[record]
when   = 'status == "failed"'
worst  = { metric = "torque_error", count = 1, per = "robot" }
max_hz = 50
"""

RUN = """schema = 1
name = "fuzzed"
[defaults]
excitation = { use = "fourier", harmonics = 2, period = "2 s" }
held_out = ["ptp"]
noise = { tau = "1 %" }
[[robot]]
use = "scara"
[[estimator]]
use = "ols"
[[estimator]]
use = "wls"
[[table]]
name = "main"
rows = ["robot"]
columns = ["estimator"]
cells = { metric = "torque_error" }
"""

MANIFEST = """name  = "scara"
title = "A robot"
file  = "scara.xml"
tool  = "spindle"
terms = ["viscous", "coulomb", "lift.k"]
free_base = false
gravity = [0, 0, -9.81]
assets = "."
[locked]
shoulder = 0.1
[limits.all]
v = 5.0
a = 30.0
[limits.lift]
q = [0.0, 0.2]
v = 1.0
a = 8.0
tau = 100.0
[joints.lift]
armature = 0.1
viscous = 0.2
coulomb = 0.3
viscous_coupling = { elbow = 0.01 }
[[sensor]]
name = "wrist"
at = "spindle"
[source]
licence = "MIT"
"""

LOG = """file   = "log.csv"
rate   = "100 Hz"
time   = { column = "t", unit = "s" }
period = "1.0 s"
joints = ["shoulder", "elbow", "lift", "spin"]
q      = { columns = ["a", "b", "c", "d"], unit = ["rad", "deg", "m", "rad"], ratio = [1, 1, 1, 1] }
tau    = { columns = [6, 7, 8, 9], offset = 0.0 }
rows   = [1, 110]
transmission = [
  [1, 0, 0, 0],
  [0, 1, 0, 0],
  [0, 0.5, 1, 0],
  [0, 0, 0, 1],
]
"""

URDF = """<?xml version="1.0"?>
<robot name="two">
  <link name="base"/>
  <link name="a">
    <inertial><origin xyz="0 0 0.1" rpy="0 0.1 0"/><mass value="1.5"/>
      <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.01"/></inertial>
    <visual><geometry><mesh filename="a.stl" scale="1 1 1"/></geometry></visual>
  </link>
  <link name="b">
    <inertial><mass value="0.5"/><inertia ixx="0.01" iyy="0.01" izz="0.01"/></inertial>
    <collision><geometry><box size="0.1 0.1 0.2"/></geometry></collision>
  </link>
  <link name="c">
    <inertial><mass value="0.1"/><inertia ixx="1e-3" iyy="1e-3" izz="1e-3"/></inertial>
  </link>
  <link name="tool"/>
  <joint name="j1" type="revolute">
    <parent link="base"/><child link="a"/><origin xyz="0 0 0.2" rpy="0.1 0 0"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" effort="50" velocity="3"/><dynamics damping="0.1" friction="0.2"/>
  </joint>
  <joint name="j2" type="prismatic">
    <parent link="a"/><child link="b"/><origin xyz="0.1 0 0"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.3" effort="50" velocity="1"/>
  </joint>
  <joint name="j3" type="continuous">
    <parent link="a"/><child link="c"/><axis xyz="0 1 0"/>
    <mimic joint="j1" multiplier="-0.5" offset="0.1"/>
  </joint>
  <joint name="fixed" type="fixed"><parent link="b"/><child link="tool"/></joint>
  <mujoco><compiler balanceinertia="true"/></mujoco>
</robot>
"""

MJCF = {
    "robot.xml": """<mujoco model="fuzzed">
  <compiler angle="radian" meshdir="." inertiafromgeom="auto"/>
  <option timestep="0.002" gravity="0 0 -9.81"/>
  <size nuser_body="2"/>
  <default><default class="small"><joint damping="0.1" range="-1 1"/></default></default>
  <asset><mesh name="part" file="part.stl" scale="1 1 1"/></asset>
  <worldbody>
    <include file="arm.xml"/>
    <replicate count="2" offset="0.5 0 0"><geom size="0.1"/></replicate>
  </worldbody>
  <equality><joint joint1="j1" joint2="j2" polycoef="0 1 0 0 0"/></equality>
  <actuator><motor joint="j1" gear="2" ctrlrange="-5 5"/></actuator>
  <sensor><force site="tip"/></sensor>
</mujoco>
""",
    "arm.xml": """<mujocoinclude>
  <body name="a" pos="0 0 0.2" quat="1 0 0 0">
    <joint name="j1" type="hinge" axis="0 0 1" limited="true" range="-2 2" armature="0.01"/>
    <inertial pos="0 0 0.1" mass="1" diaginertia="0.02 0.02 0.01"/>
    <body name="b" pos="0.2 0 0">
      <joint name="j2" type="slide" axis="1 0 0" frictionloss="0.1" class="small"/>
      <geom type="mesh" mesh="part" density="1000"/>
      <site name="tip" pos="0.1 0 0"/>
      <body name="c"><joint name="j3" type="ball"/><geom type="box" size="0.1 0.1 0.1"/></body>
    </body>
  </body>
</mujocoinclude>
""",
}

DH = """# let l1 = 0.4
# let l2 = 2*l1 - 100e-3
link,joint,prev,a,alpha,d,theta,mass,size
1,R,0,0,-90*deg,l1,q1 + pi/2,2,0.1 0.1 0.2
2,R,1,l2,0,0,q2,1.5,0.1 0.1 0.1
3,P,2,0,pi,q3,0,1,
"""

VALUES = '{"1": 0.5}'

MOTORS = """[all]
torque_max = 10
[joint1]
motor = "DM4340"
id = 1
[joint2]
motor = "DM4310"
"""

PAYLOADS = """
{ mass = 1.2, com = [0, 0, 0.05], inertia = "sphere 0.05 m" }
{ mass = 1.2, inertia = [1, 0, 0, 1, 0, 1], name = "p" }
{ mass = 2, inertia = "box 10 10 20 cm" }
point-1kg
"""

QUANTITIES = """
5 s
1 kHz
20 %
1e-4 rad
1.5 GB
"""

CONDITIONS = """
robot == "panda" and noise.tau < 0.01
estimator in ["ols", "wls"] or not robot.free_base
(rate >= "100 Hz") and torque_error == none
not -1 < repeat <= 3
"""

PLUG_INS = """
estimator ols
excitation fourier
log_reader delimited-text
plant stribeck
estimator sysid_bench.identification.estimators.linear:OLS
log_reader parquet
"""

ENVIRONMENT = """SYSID_BENCH_CACHE=cache
SYSID_BENCH_KERNEL=numpy
SYSID_BENCH_DATA=data
XDG_CACHE_HOME=.cache
HOME=.
TMPDIR=.
MPLBACKEND=agg
COLUMNS=80
PYTHONPATH=.
OMP_NUM_THREADS=1
"""

LOG_SUITE = """schema = 1
name = "logs"
[[log]]
name   = "one"
robot  = "scara"
filter = "average 5"
moving = 0.1
choose = ["offset"]
train  = [{ use = "log.toml", name = "day 1" }, { use = "log.toml", file = "other.csv" }]
test   = [{ use = "log.toml", file = "$HOME/log.csv" }]
[[estimator]]
use = "wls"
"""

PLUG_IN = '''"""An estimator."""

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Mine:
    """Least squares with a ridge."""

    weight: float = field(default=1e-3, metadata={"unit": "1"})

    def estimate(self, regression, prior=None):
        W, y = regression.W, regression.y
        return np.linalg.solve(W.T @ W + self.weight * np.eye(W.shape[1]), W.T @ y)


if __name__ == "__main__":
    print(Mine())
'''

PLUG_IN_SUITE = """schema = 1
name = "mine"
[[robot]]
use = "scara"
[[estimator]]
use = "file:mine.py:Mine"
weight = 0.5
"""

OBJ = """v 0 0 0
v 0.1 0 0
v 0 0.1 0
v 0 0 0.1
f 1 3 2
f 1 2 4
f 1 4 3
f 2 3 4
"""

OBJ_MODEL = """<mujoco model="mesh">
  <asset><mesh name="part" file="part.obj"/></asset>
  <worldbody>
    <body><joint type="hinge"/><geom type="mesh" mesh="part" density="1000"/></body>
  </worldbody>
</mujoco>
"""

ROBOT_FILES = """
example-robot-data:ur_description/urdf/ur3_robot.urdf
scara
scara
"""

PLANT = """schema = 1
title = "friction, errors, sensors"
simulation = { use = "closed-loop", rate = "1 kHz", substeps = 4 }
pipeline = "parallel"
noise = { quantum = "2.4e-5 rad", tau = "1 %" }
effects = [
    { use = "lugre", presliding = { from = 2e-4, to = 2e-3 }, peak = "20 %" },
    { use = "load-friction", coulomb = "2 %" },
    { use = "warm-up", viscous = "5 %", elapsed = "30 min" },
    "matched",
]
errors = [{ use = "gear-ratio", error = [0.01, -0.01, 0, "0.5 %"] }, "base-tilt"]
sensors = [{ use = "torque-noise", share = "1 %", time_constant = "50 ms" }, { use = "delay" }]
"""

PLANT_SUITE = """schema = 1
name = "plants"
[defaults]
plant = ["file:plant.toml", "L1"]
[[robot]]
use = "scara"
[[estimator]]
use = "ols"
"""

RUN_COMMANDS = """status run --json
cell run 0 --json
table run main --format csv
report run
record run 'torque_error > 1e9'
view run zz --web
merge run -o merged --mixed
run run --jobs 1 --shard 1/2 --timeout 60s --limit 1 --rerun failed
check-plugin plain --kind pipeline
doctor --json
"""
