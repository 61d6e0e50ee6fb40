"""gpebo's sweeper, where Hydra looks for plugins: the namespace package ``hydra_plugins``.

Every Hydra program in the environment loads this file, so it imports nothing of gpebo until a
sweep begins. Annotations are not postponed: Hydra executes plugins before it registers them in
``sys.modules``, where postponed ones would be looked up.
"""

from dataclasses import dataclass
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser


@dataclass
class GpeboSweeperConf:
    """What ``hydra.sweeper`` can be told."""

    _target_: str = "hydra_plugins.gpebo_sweeper.GpeboSweeper"
    max_batch_size: int | None = None  # jobs handed to the launcher at once; null: all
    params: dict[str, str] | None = None  # a sweep stored in a recipe
    resume: str | None = None  # folder of a sweep to go on with
    fail_fast: bool = False
    dry_run: bool = False
    quiet: bool = False


class GpeboSweeper(BasicSweeper):
    """Hydra's product of values, as jobs that are planned, recorded and resumable.

    What is swept and in which order is Hydra's own (``split_arguments``).
    """

    def __init__(
        self, max_batch_size: int | None = None, params: dict[str, str] | None = None, **_: object
    ) -> None:
        super().__init__(max_batch_size, params)

    def sweep(self, arguments: list[str]) -> Any:
        """Run the jobs of ``arguments`` and of ``params``; arguments win.

        Raises:
            GpeboError: a job failed or has no result; the table has been written then.
        """
        from gpebo_cli.cli.arguments import logspace
        from gpebo_cli.cli.sweep import check_number, run_sweep

        if self.config is None or self.launcher is None or self.hydra_context is None:
            raise RuntimeError("sweep() before setup()")  # Hydra never does
        loader = self.hydra_context.config_loader
        stored = [
            f"{key}={logspace(str(value), key) or value}" for key, value in self.params.items()
        ]
        parser = OverridesParser.create(config_loader=loader)
        parsed = parser.parse_overrides([*stored, *arguments])
        check_number(parsed)
        (jobs,) = self.split_arguments(parsed, None)
        run_sweep(jobs, self.config, self.launcher, loader)


ConfigStore.instance().store(
    group="hydra/sweeper", name="gpebo", node=GpeboSweeperConf, provider="gpebo"
)
