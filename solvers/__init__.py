"""The methods, one module each, in the order in which menus show them. A new method is a new file and one line in `MODULES`."""

from __future__ import annotations

from importlib import import_module

from ..adjoint_gi.core.method.registry import arrange

MODULES: tuple[str, ...] = (
    # Gathering, deterministic.
    "local_illumination",
    "whitted",
    "matrix_radiosity",
    "directional_radiosity",  # shooting, too, by setting
    "two_pass",  # the second pass is nondeterministic
    # Gathering, nondeterministic.
    "distribution",
    "irradiance_cache",
    "path_tracing",
    # Shooting, deterministic.
    "progressive_radiosity",
    "spherical_harmonics",
    # Shooting, nondeterministic.
    "particle_tracing",
    "stochastic_jacobi",
    # Shooting, then gathering; both natures.
    "multi_pass",
    # Shooting, either nature.
    "potential",
)


def load() -> None:
    """Import every module of `MODULES`, which enters its methods in the registry; calling it again changes nothing.

    Raises ImportError naming the module that cannot be imported: a missing method is never passed over in silence.
    """
    for name in MODULES:
        try:
            import_module(f".{name}", __name__)
        except Exception as error:
            raise ImportError(f"method module solvers/{name}.py cannot be loaded: {error}") from error
    arrange(MODULES)
