"""Spectra of residuals on the tests of a robot, and on those of its twins."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from scipy.signal import welch

from sysid_bench.apps.twins.agreement import HIGHEST, LOWEST, SEGMENT, Residual
from sysid_bench.reporting.signal_figures import ResidualSpectra
from sysid_bench.types import Array

POINTS: Final = 60
"""Frequencies of a spectrum, evenly spaced in their logarithm."""


def residual_spectra(
    joints: Sequence[str], residuals: Mapping[str, Sequence[Residual]]
) -> ResidualSpectra:
    """Return the spectra of each source, averaged over its tests and draws."""
    f = np.geomspace(LOWEST, HIGHEST, POINTS)
    densities = {
        source: np.mean([_density(one, f) for one in several], axis=0)
        for source, several in residuals.items()
    }
    return ResidualSpectra(tuple(joints), f, densities)


def _density(residual: Residual, f: Array) -> Array:
    """Density (m, n) at frequencies f (m,)."""
    samples = min(len(residual.e), round(SEGMENT * residual.rate))
    own, density = welch(residual.e, residual.rate, nperseg=samples, axis=0)
    columns = [np.interp(f, own[1:], column[1:]) for column in density.T]
    return np.asarray(np.maximum(np.column_stack(columns), 1e-30))
