"""gpebo: adaptive state observers for linear time-varying descriptor systems.

    from gpebo_cli import run

    result = run("circuit", estimator="drem", gamma=[1e8, 1e10])
    result["il"], result.estimates["il"]      # by name, (N,) and (cases, M)
    result.to_pandas("cases")
    result.plot()
    result.save("first")                      # the folder that gpebo run writes

Nothing is imported before it is used: ``gpebo --help`` loads no numbers.
"""

from gpebo_cli._version import __version__

TYPE_CHECKING = False  # as typing has it; importing typing takes longer than all the rest here
if TYPE_CHECKING:  # for editors and type checkers; at run time __getattr__ below finds them
    from gpebo_cli.api.calls import available, check, load_plant, run
    from gpebo_cli.api.result import Result
    from gpebo_cli.errors import ConfigError, GpeboError, ModelError, SolverError
    from gpebo_cli.importers import (
        from_control,
        from_file,
        from_matrices,
        from_mechanics,
        from_netlist,
    )
    from gpebo_cli.model.descriptor import DescriptorSystem
    from gpebo_cli.model.functions import Names, system_from_functions
    from gpebo_cli.observers import Measurements, observe
    from gpebo_cli.settings import SolverSettings, TimeSettings
    from gpebo_cli.simulation.simulate import simulate

__all__ = [
    "ConfigError", "DescriptorSystem", "GpeboError", "Measurements", "ModelError", "Names",
    "Result", "SolverError", "SolverSettings", "TimeSettings", "__version__", "available", "check",
    "from_control", "from_file", "from_matrices", "from_mechanics", "from_netlist", "load_plant",
    "observe", "run", "simulate", "system_from_functions",
]

_HOMES = {
    "api.calls": ("available", "check", "load_plant", "run"),
    "api.result": ("Result",),
    "errors": ("ConfigError", "GpeboError", "ModelError", "SolverError"),
    "importers": (
        "from_control", "from_file", "from_matrices", "from_mechanics", "from_netlist",
    ),
    "observers": ("Measurements", "observe"),
    "settings": ("SolverSettings", "TimeSettings"),
    "simulation.simulate": ("simulate",),
    "model.descriptor": ("DescriptorSystem",),
    "model.functions": ("Names", "system_from_functions"),
}


def __getattr__(name: str) -> object:
    from importlib import import_module

    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{home}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
