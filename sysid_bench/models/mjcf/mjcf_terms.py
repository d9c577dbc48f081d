"""Joint terms of an MJCF, gathered at its joints; all other forces are left out and reported.

Torque is taken at the joint, not at the motor: gears are not part of the model, and the armature
and damping that an actuator of MuJoCo 4 adds to its joint, times the gear squared, are joint
armature and joint damping. Flags that disable springs, dampers or friction are obeyed. Other forces
(tendons, gravity compensation, a medium, polynomials) are left out of the simulated robot.
"""

from collections.abc import Iterator, Sequence
from typing import Any, Final

import mujoco
import numpy as np

_SCALAR: Final = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
AT_JOINT: Final = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_DISABLING: Final = {
    "stiffness": int(mujoco.mjtDisableBit.mjDSBL_SPRING),
    "damping": int(mujoco.mjtDisableBit.mjDSBL_DAMPER),
    "frictionloss": int(mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS),
}
"""Joint terms, and the flag of MuJoCo that switches each off."""


def joint_terms_of(spec: mujoco.MjSpec) -> tuple[str, ...]:
    """Gather the joint terms of a spec at its joints; return what is left out, in words."""
    left_out = [*_reflect_actuators(spec), *_drop_polynomials(spec)]
    _obey_flags(spec)
    return (
        *left_out,
        *_drop_springs_of_balls(spec),
        *_drop_tendon_forces(spec),
        *_drop_medium(spec),
        *_drop_gravity_compensation(spec),
    )


def _reflect_actuators(spec: mujoco.MjSpec) -> Iterator[str]:
    """Move armature and damping of actuators to the joints they act on."""
    joints = {joint.name: joint for joint in spec.joints}
    for actuator in filter(_has_terms, spec.actuators):
        joint = joints.get(actuator.target)
        if joint is None or not _moves_scalar(actuator, joint):
            name = _called(actuator)
            yield f"armature and damping of actuator {name} left out: it acts on no hinge or slide"
            continue
        yield from _reflect(actuator, joint)


def _has_terms(actuator: mujoco.MjsActuator) -> bool:
    return bool(actuator.armature or _damping(actuator).any())


def _damping(actuator: mujoco.MjsActuator) -> Any:
    return np.atleast_1d(np.asarray(actuator.damping, dtype=float))


def _moves_scalar(actuator: mujoco.MjsActuator, joint: mujoco.MjsJoint) -> bool:
    return int(actuator.trntype) in AT_JOINT and int(joint.type) in _SCALAR


def _reflect(actuator: mujoco.MjsActuator, joint: mujoco.MjsJoint) -> Iterator[str]:
    damping = _damping(actuator)
    if damping[1:].any():
        yield f"non-linear damping of actuator {_called(actuator)} left out"
    # The motor turns `gear` times as fast and its torque counts `gear` times: hence the square.
    square = float(actuator.gear[0]) ** 2
    joint.armature += square * actuator.armature
    joint.damping = np.asarray(joint.damping) + _first(joint.damping, square * damping[0])


def _drop_polynomials(spec: mujoco.MjSpec) -> Iterator[str]:
    for joint in spec.joints:
        for key, word in (("stiffness", "spring"), ("damping", "damper")):
            numbers = np.asarray(getattr(joint, key), dtype=float)
            if numbers[1:].any():
                setattr(joint, key, _first(numbers, numbers[0]))
                yield f"non-linear part of the {word} of joint {_called(joint)} left out"


def _obey_flags(spec: mujoco.MjSpec) -> None:
    """Zero the terms that the model disables, and clear the flags."""
    flags = int(spec.option.disableflags)
    for key, bit in _DISABLING.items():
        for joint in spec.joints if flags & bit else ():
            setattr(joint, key, _zero(getattr(joint, key)))
        spec.option.disableflags &= ~bit


def _drop_springs_of_balls(spec: mujoco.MjSpec) -> Iterator[str]:
    for joint in spec.joints:
        # Its torque depends on a rotation vector, not on one coordinate as the other springs do.
        if int(joint.type) not in _SCALAR and _zero_terms(joint, ("stiffness",)):
            yield f"spring of joint {_called(joint)} left out: it is neither hinge nor slide"


def _drop_tendon_forces(spec: mujoco.MjSpec) -> Iterator[str]:
    for tendon in spec.tendons:
        if found := _zero_terms(tendon, ("stiffness", "damping", "frictionloss", "armature")):
            terms = ", ".join(found)
            yield f"{terms} of tendon {_called(tendon)} left out: not a term of one joint"


def _zero_terms(element: Any, keys: Sequence[str]) -> list[str]:
    """Set terms of an element to zero; return those that were not."""
    found = [key for key in keys if np.any(getattr(element, key))]
    for key in found:
        setattr(element, key, _zero(getattr(element, key)))
    return found


def _drop_medium(spec: mujoco.MjSpec) -> Iterator[str]:
    # Drag depends on the shapes of bodies, which are not a part of the regressor.
    if spec.option.density or spec.option.viscosity:
        spec.option.density = spec.option.viscosity = 0.0
        yield "forces of the medium (density, viscosity) left out"


def _drop_gravity_compensation(spec: mujoco.MjSpec) -> Iterator[str]:
    # It is a force at the body, hence neither in M(q) a + h(q, v) nor in a joint term.
    lifted = [body for body in spec.bodies if _zero_terms(body, ("gravcomp",))]
    if lifted:
        yield f"gravity compensation of {', '.join(map(_called, lifted))} left out"


def _called(element: Any) -> str:
    return repr(element.name) if element.name else "(unnamed)"


def _first(like: Any, value: Any) -> Any:
    new = np.zeros_like(np.asarray(like, dtype=float))
    new[0] = value
    return new


def _zero(value: Any) -> Any:
    return 0.0 if np.ndim(value) == 0 else np.zeros_like(value)
