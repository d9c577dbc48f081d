"""Compiled steps of a method's model along measured torques, with derivatives: those of lanes.c.

Filters and rollouts evaluate any beta, also such as no physical body has. The numbers of a tree,
inertias and joint terms, are affine in beta; this is a model of scalar joints alone."""

import ctypes
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np

from sysid_bench.instruction_sets import LEVELS
from sysid_bench.models.tree import HINGE, SLIDE
from sysid_bench.simulation.candidate import KnownModel, plant_of_model
from sysid_bench.simulation.plant_batch import frames_of, lanes_library, tree_in_c
from sysid_bench.types import Array

_TERMS: Final = ("armature", "viscous", "coulomb", "spring", "offset")


@dataclass(frozen=True, eq=False)
class ForwardModel:
    """The model of a method as a function of its base parameters: those at the indices `pivots`
    (r,), the others zero."""

    known: KnownModel
    pivots: Array

    def along(
        self, numbers: Mapping[str, float], motion: Mapping[str, Array]
    ) -> "ForwardSteps | None":
        """Return its steps along a motion, or None where lanes.c has none.

        `numbers`: time `dt` (s) and number `substeps` of steps from one sample to the next, the
        finite-difference step `nudge`, and the largest state, `far`. `motion`: torques `tau`
        (N, nv), the base parameters that are `jumping` (s,) with the state and have no derivative
        by it, those of the `columns` (k,) that follow the motion by their torque `friction`
        (N, nv, k); and the accelerations `a` (N, nv) of joints that are `standing` (N, nv).
        """
        robot = self.known.robot
        kinds = {joint.kind for joint in robot.tree.joints}
        if isinstance(lanes_library(), str) or kinds - {HINGE, SLIDE} or robot.coupling is not None:
            return None
        return ForwardSteps(self, dict(numbers), dict(motion))

    @cached_property
    def numbers(self) -> tuple[Array, Array]:
        """Numbers (m,) of lanes.c at beta = 0, and those by each base parameter (r, m)."""
        p = len(self.known.parameters)
        nothing = self._numbers(np.zeros(p))
        units = [self._numbers(np.eye(1, p, i)[0]) - nothing for i in self.pivots]
        return nothing, np.array(units).reshape(-1, len(nothing))

    def _numbers(self, theta: Array) -> Array:
        plant = plant_of_model(self.known, theta)
        assert plant.phi is not None
        inertia = frames_of(plant.robot.tree).X.reshape(-1, plant.phi.size) @ plant.phi.ravel()
        return np.concatenate([inertia, *(getattr(plant.terms, name) for name in _TERMS)])


@dataclass(frozen=True, eq=False)
class ForwardSteps:
    """Functions of lanes.c with the address of their tree and model first and of `memory` last."""

    model: ForwardModel
    given: dict[str, float]
    motion: dict[str, Array]

    def call(self, name: str, *arguments: Any) -> int:
        """Call a function with numbers and arrays; return its code: 0, 1 where a mass matrix is
        singular, 2 where the state is too large."""
        given = [
            ctypes.c_int64(x) if isinstance(x, int)
            else ctypes.c_void_p(None if x is None else x.ctypes.data)
            for x in arguments
        ]  # fmt: skip
        return int(self.function(name)(*self.arguments, *given, self.memory))

    def function(self, name: str) -> Any:
        """Return a function of lanes.c for this processor."""
        dll, level = lanes_library()
        function = getattr(dll, f"{name}_{LEVELS[level]}")
        function.restype = ctypes.c_int64
        return function

    @cached_property
    def arguments(self) -> tuple[Any, Any]:
        """Tree and model."""
        robot = self.model.known.robot
        tree = tree_in_c(robot.tree, robot.joint_terms.spring_reference)
        vars(self)["owned"] = tree, self._model
        return ctypes.byref(tree), ctypes.byref(self._model)

    @cached_property
    def memory(self) -> ctypes.c_void_p:
        """Scratch memory."""
        scratch = np.empty(self.function("model_work")(*self.arguments), np.uint8)
        vars(self)["scratch"] = scratch
        return ctypes.c_void_p(scratch.ctypes.data)

    @cached_property
    def _model(self) -> "_Model":
        known, by_beta = self.model.numbers
        motion, every = self.motion, np.arange(len(by_beta))
        of, place = np.nonzero(by_beta)
        whole = {
            "first": np.searchsorted(of, np.arange(len(by_beta) + 1)),
            "place": place,
            "column": motion["columns"],
            "follows": np.isin(every, motion["columns"]),
            "jumping": np.isin(every, motion["jumping"]),
            "standing": motion["standing"],
        }
        real = {name: motion[name] for name in ("tau", "friction", "a")}
        real |= {"known": known, "weight": by_beta[of, place]}
        arrays = {name: np.ascontiguousarray(x, np.int64) for name, x in whole.items()}
        arrays |= {name: np.ascontiguousarray(x, float) for name, x in real.items()}
        made = _Model(
            r=len(every), columns=len(motion["columns"]), stands=bool(motion["standing"].any()),
            **self.given, **{name: x.ctypes.data for name, x in arrays.items()},
        )  # fmt: skip
        made.arrays = arrays  # C sees addresses alone
        return made


class _Model(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("r", "substeps", "columns", "stands")),
        *((name, ctypes.c_double) for name in ("dt", "nudge", "far")),
        *((name, ctypes.c_void_p) for name in
          ("known", "weight", "first", "place", "column", "follows", "jumping", "standing", "tau",
           "friction", "a")),
    )  # fmt: skip
