"""Results of runs that never ran: plausible signals of a circuit, made from formulas."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from gpebo_cli.evidence.excitation import Excitation
from gpebo_cli.evidence.knowledge import knowledge
from gpebo_cli.evidence.metrics import Metrics
from gpebo_cli.experiment.result import (
    EstimationResult,
    RegressionResult,
    RunResult,
    SimulationResult,
    StateChange,
)
from gpebo_cli.findings import Assumption, Requirement
from gpebo_cli.model.descriptor import Array, Coefficients, DescriptorSystem
from gpebo_cli.settings import OutputSettings, Settings

STATES = ("e1", "e2", "il", "ir1", "ir2", "iv")
UNITS = {"e1": "V", "e2": "V", "il": "A", "ir1": "A", "ir2": "A", "iv": "A", "V": "V", "y": "A"}


@dataclass(frozen=True)
class NoCoefficients:
    """A coefficient source for tests that never evaluate the model."""

    constant: frozenset[str] = frozenset()

    def taylor(self, t: Array, order: int, inside: Array | None = None) -> Coefficients:
        """Refuse: there is nothing to evaluate."""
        raise NotImplementedError

    def breakpoints(self, start: float, stop: float) -> Array:
        """No jumps."""
        return np.zeros(0)


def make_system(units: Mapping[str, str] = UNITS) -> DescriptorSystem:
    """Names and units of the circuit."""
    return DescriptorSystem(
        name="circuit",
        states=STATES,
        coefficients=NoCoefficients(),
        initial_state=np.array([0.0, 1.0, 2.0, 0.25, 0.0, -0.25]),
        inputs=("V",),
        outputs=("y",),
        title="circuit with time-varying elements",
        reference="arXiv:2407.14373",
        units=dict(units),
        labels={"il": "i_L"},
    )


def make_result(
    gammas: tuple[float, ...] = (1e10, 1e8),
    samples: int = 1001,
    mixing: bool = True,
    parameters: tuple[str, ...] = ("e0_e1", "e0_e2", "e0_il"),
    thin: int = 1,
    units: Mapping[str, str] = UNITS,
) -> RunResult:
    """One case per gain; its errors decay from about 1 to rounding, sooner for larger gains."""
    rng = np.random.default_rng(20240719)
    t = np.linspace(0.0, 20.0, samples)
    phases = np.arange(6)
    sizes = np.array([3.0, 1.0, 2.0, 1.5, 1.0, 18.0])
    states = sizes * np.exp(-0.03 * t)[:, None] * np.cos(1.3 * t[:, None] + phases)
    inputs = (4 * np.cos(2 * t) * np.sin(t / 5))[:, None]
    outputs = states[:, [2]] + states[:, [5]]
    moved = (StateChange("iv", -0.25, -3.45, 0.0),)
    simulation = SimulationResult(
        t=t,
        inputs=inputs,
        outputs=outputs,
        states=states,
        index=2,
        strangeness_index=1,
        differential=2,
        algebraic=4,
        initial_state=states[0],
        moved=moved,
        jumps=(),
        impulses=(),
        error_estimate=3e-13,
        elements=40,
        state_errors=np.array([1e-13] * 5 + [3e-13]),
    )
    p = len(parameters)
    truth = np.array([1.0, -1.0, -2.0, 0.5, 0.1, 0.2])[:p]
    growth = np.exp(0.08 * t)[:, None]
    psi = (growth * np.cos(0.15 * t[:, None] + 1.2 * np.arange(p)))[:, None, :]
    regression = RegressionResult(t, psi @ truth, psi, parameters, 2e-13)
    k = np.arange(p)
    eigenvalues = 10.0 ** (2 * k - 4) * t[:, None] ** (5 - 2 * k)
    eigenvalues = np.sort(eigenvalues, axis=1)
    known = knowledge(np.tile(np.eye(p), (len(t), 1, 1)), np.ones(p), t + 1.0)
    excitation = Excitation(
        t=t,
        gram_eigenvalues=eigenvalues,
        pe_level=0.01 * (1 - np.exp(-t)),
        window=2.0,
        t_c=0.24,
        rho=1e-7,
        lambda_min=float(eigenvalues[-1].min(initial=np.inf)),
        parameters=tuple(parameters),
        known=known,
        final=known.at(slice(-1, None)),
    )
    coarse = t[::thin]
    delta = 1e-3 * (1 - np.exp(-0.02 * coarse**2)) ** 4 if mixing else None
    rate = np.array([0.12 * np.log10(gamma) for gamma in gammas])[:, None]
    decay = np.maximum(np.exp(-rate * 0.05 * coarse**2.5), 1e-15)
    fuzz = 1 + 0.5 * (decay < 1e-13) * rng.standard_normal(decay.shape)
    decay = (decay * fuzz)[:, :, None]
    estimated = truth * (1 - decay)
    estimated_states = states[::thin] + decay * sizes * np.cos(0.7 * coarse[:, None] + phases)
    reached = np.array([np.nan if gamma < 1e8 else 60.0 / np.log10(gamma) for gamma in gammas])
    final = np.abs(estimated_states[:, -1] - states[-1]).max(axis=1)
    metrics = Metrics(
        reached, reached + 0.3, np.abs(estimated[:, -1] - truth).max(1, initial=0.0), final, final
    )
    return RunResult(
        settings=Settings(estimator={"name": "drem", "gamma": list(gammas)}),
        system=make_system(units),
        simulation=simulation,
        regression=regression,
        excitation=excitation,
        estimation=EstimationResult(
            cases=tuple({"gamma": gamma} for gamma in gammas),
            t=coarse,
            names=parameters,
            parameters=estimated,
            true_parameters=np.broadcast_to(truth, (len(coarse), p)),
            states=estimated_states,
            delta=None if delta is None else delta[None],
            checks={},
            requirement=Requirement("Δ not in L2", True, {"integral": 1e-5}, "enough excitation"),
            still=np.zeros(len(gammas), dtype=bool),
        ),
        metrics=metrics,
        assumptions=(
            Assumption("Assumption 1", "rank(𝒜 Q) = n_b", True, {"sigma_min": 0.3, "at": None}),
        ),
        timings={"simulate": 0.002, "estimate": 0.001},
        verdict="done: parameters within 1 % after 5.02 s",
    )


def without_observer(result: RunResult) -> RunResult:
    """The same run with ``observer=none``."""
    return replace(
        result,
        settings=replace(result.settings, observer={"name": "none"}),
        regression=None,
        excitation=None,
        estimation=None,
        metrics=None,
    )


def with_figures(result: RunResult, figures: bool | list[str]) -> RunResult:
    """The same run, asked for other figures."""
    settings = replace(result.settings, output=OutputSettings(figures=figures))
    return replace(result, settings=settings)
