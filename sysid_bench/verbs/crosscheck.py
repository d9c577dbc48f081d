"""Any robot in both engines, without a suite."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from sysid_bench.errors import UsageError, reason_of
from sysid_bench.types import BaseMap


def crosscheck(
    *sources: str | Path,
    samples: int = 50,
    free_base: bool | None = None,
    robots_dir: Path | None = None,
    assets: Path | None = None,
) -> list[dict[str, Any]]:
    """The verdict on each robot name or model file, as `crosscheck --json` prints it.

    A file that cannot be used is a verdict (ok false, with its reason); an unknown name is a
    UsageError before anything is loaded. `assets`: the folder that MJCF files may read below,
    instead of their own.
    """
    from sysid_bench.models.manifest import Manifest, find_manifest

    if samples < 1:
        raise UsageError(f"--samples {samples}: at least one state is needed to compare.")
    manifests: list[tuple[str, Manifest | Exception]] = []
    for source in sources:
        try:
            manifests.append((str(source), find_manifest(str(source), robots_dir)))
        except UsageError:
            raise
        except Exception as error:
            manifests.append((str(source), error))
    if assets is not None:
        manifests = [
            (source, m if isinstance(m, Exception) else replace(m, assets=assets))
            for source, m in manifests
        ]
    return [_verdict(source, manifest, samples, free_base) for source, manifest in manifests]


def _verdict(source: str, manifest: Any, samples: int, free_base: bool | None) -> dict[str, Any]:
    if isinstance(manifest, Exception):
        return _refused(Path(source).stem, source, manifest)
    try:
        return _measured(manifest, samples, free_base)
    except Exception as error:  # one file never takes the others with it
        return _refused(manifest.name, str(manifest.path), error)


def _measured(manifest: Any, samples: int, free_base: bool | None) -> dict[str, Any]:
    from sysid_bench.evaluation.crosscheck import crosscheck as check
    from sysid_bench.identifiability.structural import structural_base
    from sysid_bench.models.load import load_robot

    robot = load_robot(manifest, free_base=free_base)
    verdict = check(robot, samples)
    base: BaseMap = structural_base(robot.uncoupled, robot.inertial_columns)
    return {
        "robot": robot.name,
        "file": str(manifest.path),
        "ok": verdict.ok(),
        "reason": verdict.reason(),
        "nq": robot.tree.nq,
        "nv": robot.nv,
        "bodies": len(robot.body_names),
        "joints": [{"name": joint.name, "type": joint.kind} for joint in robot.joints],
        "gap": verdict.gap,
        "closure": verdict.closure,
        "native_gap": verdict.native_gap,
        "native_reason": verdict.native_reason,
        "base_parameters": base.rank,
        "near_degenerate": base.near_degenerate,
        "coupling": _coupling(robot, verdict),
        "repairs": list(robot.repairs),
    }


def _coupling(robot: Any, verdict: Any) -> dict[str, Any] | None:
    """Names of the joints that move and that follow, the figures, and the base parameters that
    their torques tell."""
    from sysid_bench.identifiability.structural import structural_base

    if robot.coupling is None:
        return None
    check, names = verdict.coupling, robot.rows
    return {
        "independent": list(robot.torque_rows),
        "dependent": [names[dof] for dof in robot.coupling.dependent],
        "gap": check.gap,
        "closure": check.closure,
        "jacobian": check.jacobian,
        "violation": check.violation,
        "coupled_base_parameters": structural_base(robot, robot.inertial_columns).rank,
    }


def _refused(name: str, file: str, error: Exception) -> dict[str, Any]:
    nothing: dict[str, Any] = dict.fromkeys(_MEASURED)
    return {
        "robot": name,
        "file": file,
        "ok": False,
        "reason": reason_of(error),
        **nothing,
        "repairs": [],
    }


_MEASURED: Sequence[str] = (
    "nq", "nv", "bodies", "joints", "gap", "closure", "native_gap", "native_reason",
    "base_parameters", "near_degenerate", "coupling",
)  # fmt: skip
