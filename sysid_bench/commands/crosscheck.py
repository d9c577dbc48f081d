"""Verb `crosscheck`: any robot model compared between MuJoCo and Pinocchio, without a suite."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sysid_bench.commands.request import (
    FAILED,
    OK,
    Request,
    free_base_option,
    model,
    option,
    robots_option,
)
from sysid_bench.commands.result import Result
from sysid_bench.errors import UsageError, reason_of

if TYPE_CHECKING:
    from sysid_bench.models.manifest import Manifest


class Crosscheck(Request["list[CrosscheckResult]"]):
    """Compare a robot's regressor between MuJoCo and Pinocchio.

    Exit code 1 where a robot is above tolerance or cannot be loaded.
    """

    sources: tuple[str | Path, ...] = model("ROBOT|FILE...", several=True)
    samples: int = option("Random states to compare at.", default=50, shown=True)
    free_base: bool | None = free_base_option()
    robots_dir: Path | None = robots_option()
    assets: Path | None = None

    def run(self) -> "list[CrosscheckResult]":
        """Return a verdict for each source."""
        if self.samples < 1:
            raise UsageError(f"--samples {self.samples}: at least one state is needed to compare.")
        for source in self.sources:
            if not isinstance(source, (str, Path)):
                raise UsageError(
                    "crosscheck takes names and files one by one, as crosscheck('ur5', 'panda'); "
                    f"got {source!r}."
                )
        # An unknown name is an error before anything is loaded.
        manifests = [(str(source), _manifest(source, self)) for source in self.sources]
        return [_verdict(source, manifest, self) for source, manifest in manifests]

    def shell(self, as_json: bool) -> int:
        from sysid_bench.commands.terminal import print_json

        verdicts = self.run()
        if as_json:
            print_json(verdicts)
        for verdict in () if as_json else verdicts:
            figures = "\n".join(verdict.figures())
            word, colour = ("agrees", "green") if verdict.ok else ("DIFFERS", "red")
            if figures:
                click.echo(figures.replace(f": {word} ", f": {click.style(word, fg=colour)} ", 1))
            if verdict.reason:
                click.echo(f"sysid-bench: {verdict.robot}: {verdict.reason}", err=True)
        return OK if all(verdict.ok for verdict in verdicts) else FAILED


def crosscheck(
    *sources: str | Path,
    samples: int = 50,
    free_base: bool | None = None,
    robots_dir: Path | None = None,
    assets: Path | None = None,
) -> "list[CrosscheckResult]":
    """Return the verdict on each robot name or model file, compared at `samples` random states.

    A file that cannot be used is a verdict (`ok` false, with its reason); an unknown name is a
    UsageError before anything is loaded. `assets`: folder that MJCF files may read from, instead
    of their own.
    """
    return Crosscheck(sources, samples, free_base, robots_dir, assets).run()


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class CrosscheckResult(Result):
    """Verdict on one robot; the figures are None for a model that could not be used.

    `gap`: max |Y - Y_pin| / max |Y_pin|, same parameter order and frames. `closure`: max |Y theta +
    armature a - tau_MuJoCo| / max |tau_MuJoCo|. `native_gap`: gap against Pinocchio's own parser,
    None with `native_reason` where it does not apply. `simulation_gap`: largest difference (rad, m)
    of positions in 0.1 s of free fall that compiled steps and MuJoCo simulate, None with
    `simulation_reason` where MuJoCo alone does. `engine`: the second one, "pinocchio" or,
    where that is not installed, "mujoco". `near_degenerate`: directions that the rank rule drops
    though they are no rounding; `rank_gap`: last kept over first dropped singular value.
    """

    robot: str
    file: str
    ok: bool
    reason: str
    nq: int | None = None
    nv: int | None = None
    bodies: int | None = None
    joints: list[dict[str, str]] | None = None
    gap: float | None = None
    closure: float | None = None
    native_gap: float | None = None
    native_reason: str | None = None
    simulation_gap: float | None = None
    simulation_reason: str | None = None
    engine: str | None = None
    base_parameters: int | None = None
    near_degenerate: int | None = None
    rank_gap: float | None = None
    coupling: dict[str, Any] | None = None
    repairs: list[str]

    def figures(self) -> list[str]:
        """Lines of what was measured; none for a model that could not be used."""
        if self.nv is None:
            return []
        from sysid_bench.identifiability.base_map import BaseCount  # loaded by the measurement

        native = f"native: {self.native_reason}"  # against Pinocchio's own parser
        if self.native_gap is not None:
            native = f"native gap {self.native_gap:.1e}"
        weak = ""
        if self.base_parameters is not None and self.near_degenerate is not None:
            own = BaseCount(self.base_parameters, self.near_degenerate, self.rank_gap)
            weak = own.dropped_text
        steps = f"simulation: {self.simulation_reason}"
        if self.simulation_gap is not None:
            steps = f"simulation gap {self.simulation_gap:.1e}"
        lines = [
            f"{self.robot}: {'agrees' if self.ok else 'DIFFERS'}  gap {self.gap:.1e}  "
            f"closure {self.closure:.1e}  {native}  {steps}",
            f"  {self.nv} degrees of freedom, {self.bodies} bodies, "
            f"{self.base_parameters} base parameters{weak}",
        ]
        if self.coupling is not None:
            keys = ("coupled_base_parameters", "coupled_near_degenerate", "coupled_rank_gap")
            of_loop = BaseCount(*(self.coupling[key] for key in keys)).dropped_text
            dependent = self.coupling["dependent"]
            names = ", ".join(dependent[:6]) + (", ..." if len(dependent) > 6 else "")
            lines.append(
                f"  coupled, {len(dependent)} followers ({names}): gap {self.coupling['gap']:.1e}  "
                f"closure {self.coupling['closure']:.1e}, "
                f"{self.coupling['coupled_base_parameters']} base parameters{of_loop}"
            )
            lines += [f"  {self.coupling['note']}"] if self.coupling["note"] else []
        for repair in self.repairs:
            lines.append(f"  {'doubtful' if repair.endswith('?') else 'repaired'}: {repair}")
        return lines

    def summary(self) -> str:
        """Measured values, and the reason of a failure."""
        return "\n".join(self.figures() + ([f"{self.robot}: {self.reason}"] if self.reason else []))


def _manifest(source: str | Path, request: Crosscheck) -> "Manifest | Exception":
    """Manifest of a robot, or the reason why its file cannot be read."""
    from sysid_bench.models.manifest import find_manifest

    try:
        manifest = find_manifest(str(source), request.robots_dir)
    # A name that is not known is a mistake of the command; a file that fails is a verdict.
    except UsageError:
        raise
    except Exception as error:
        return error
    return manifest if request.assets is None else replace(manifest, assets=request.assets)


def _verdict(
    source: str, manifest: "Manifest | Exception", request: Crosscheck
) -> CrosscheckResult:
    name, file, error = Path(source).stem, source, manifest
    if not isinstance(manifest, Exception):
        name, file = manifest.name, str(manifest.path)
        try:
            return _measured(manifest, request)
        except Exception as failure:  # one file never takes the others with it
            error = failure
    assert isinstance(error, Exception)
    return CrosscheckResult(robot=name, file=file, ok=False, reason=reason_of(error), repairs=[])


def _measured(manifest: "Manifest", request: Crosscheck) -> CrosscheckResult:
    from sysid_bench.evaluation.crosscheck import crosscheck as compare_engines
    from sysid_bench.identifiability.base_map import structural_count
    from sysid_bench.models.load import load_robot

    robot = load_robot(manifest, free_base=request.free_base)
    verdict = compare_engines(robot, request.samples)
    # Counted on the tree itself: coupled joints have fewer torque rows, reported beside.
    counted = structural_count(robot.without_coupling)
    coupling, check = None, verdict.coupling
    if robot.coupling is not None and check is not None:
        of_loop = structural_count(robot)
        coupling = {
            "independent": list(robot.torque_rows),
            "dependent": [robot.rows[dof] for dof in robot.coupling.dependent],
            "gap": check.gap,
            "closure": check.closure,
            "jacobian": check.jacobian,
            "violation": check.violation,
            "note": check.note,
            "coupled_base_parameters": of_loop.rank,
            "coupled_near_degenerate": of_loop.near_degenerate,
            "coupled_rank_gap": of_loop.gap,
        }
    return CrosscheckResult(
        robot=robot.name,
        file=str(manifest.path),
        ok=verdict.ok(),
        reason=verdict.reason(),
        nq=robot.tree.nq,
        nv=robot.nv,
        bodies=len(robot.body_names),
        joints=[{"name": joint.name, "type": joint.kind} for joint in robot.joints],
        gap=verdict.gap,
        closure=verdict.closure,
        native_gap=verdict.native_gap,
        native_reason=verdict.native_reason,
        simulation_gap=verdict.simulation_gap,
        simulation_reason=verdict.simulation_reason,
        engine=verdict.engine,
        base_parameters=counted.rank,
        near_degenerate=counted.near_degenerate,
        rank_gap=counted.gap,
        coupling=coupling,
        repairs=list(robot.repairs),
    )
