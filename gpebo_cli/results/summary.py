"""``summary.json``: everything about a run that is not a table, as strict JSON."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import numpy as np

from gpebo_cli.evidence.excitation import Excitation
from gpebo_cli.evidence.metrics import Metrics
from gpebo_cli.experiment.result import (
    EstimationResult,
    Fit,
    RecordingResult,
    RunResult,
    SimulationResult,
    StateChange,
)
from gpebo_cli.model.descriptor import DescriptorSystem
from gpebo_cli.results.provenance import Provenance
from gpebo_cli.results.symbols import unit_of
from gpebo_cli.schema import plain

MAX_LISTED_CASES = 100  # beyond, cases.csv is the place to look and the summary gives ranges


def summary_text(result: RunResult, made_by: Provenance) -> str:
    """Render :func:`summary` as strict JSON: NaN and infinities are ``null``."""
    content = strict(summary(result, made_by))
    return json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def summary(result: RunResult, made_by: Provenance) -> dict[str, Any]:
    """Summarise a run as nested dicts in the order they are printed; parts it lacks are None."""
    system, simulation = result.system, result.simulation
    regression, estimation = result.regression, result.estimation
    errors = None if simulation is None else simulation.state_errors
    by_state = None if errors is None else dict(zip(system.states, errors.tolist(), strict=True))
    return {
        "status": "done",
        "verdict": result.verdict,
        "plant": system.name,
        "title": system.title,
        "reference": system.reference,
        "observer": result.settings.observer["name"],
        "sample_time": result.settings.observer.get("sample_time"),
        "estimator": dict(result.settings.estimator) if estimation else None,
        "noise": (
            asdict(result.settings.noise) if result.signals.measured_outputs is not None else None
        ),
        **_simulation(system, simulation),
        "recording": result.recording and _recording(result.recording),
        "parameters": None if estimation is None else dict(
            zip(estimation.names, estimation.true_parameters[-1], strict=True)
        ),
        "estimates": estimation and _estimates(result, estimation),
        "active_bounds": estimation and _active_bounds(estimation),
        "estimable": {name: since is not None for name, since in result.estimable.items()},
        "assumptions": [vars(assumption) for assumption in result.assumptions],
        "warnings": result.warnings,
        "excitation": result.excitation and _excitation(result.excitation),
        "estimator_requirement": None if estimation is None else {
            key: getattr(estimation.requirement, key)
            for key in ("name", "holds", "evidence", "text")
        },
        "cases": estimation and result.metrics and _cases(estimation, result.metrics),
        "error_estimate": {
            "states": simulation.error_estimate if simulation else None,
            "by_state": by_state,
            "regression": regression.error_estimate if regression else None,
            "estimates": estimation.doubts[0] if estimation else None,
        },
        "fit": result.fit and _fit(result.fit),
        "elements": simulation.elements if simulation else None,
        "timings": dict(result.timings),
        **asdict(made_by),
    }


def strict(value: object) -> Any:
    """Reduce ``value`` to what strict JSON knows; a number that is not finite becomes None."""
    return json.loads(json.dumps(plain(value), default=str), parse_constant=lambda _: None)


def _change(change: StateChange) -> dict[str, float]:
    return {"from": change.given, "to": change.used, "change": change.used - change.given}


def _simulation(system: DescriptorSystem, simulation: SimulationResult | None) -> dict[str, Any]:
    """Index, consistent start and jumps of the simulated plant; None for each of a recording."""
    numbers = ("index", "strangeness_index", "differential", "algebraic")
    if simulation is None:
        return dict.fromkeys((*numbers, "initial_state", "jumps", "impulses"))
    return {
        **{name: getattr(simulation, name) for name in numbers},
        "initial_state": {
            "given": dict(zip(system.states, system.initial_state, strict=True)),
            "used": dict(zip(system.states, simulation.initial_state, strict=True)),
            "moved": {change.state: _change(change) for change in simulation.moved},
        },
        "jumps": [
            {"time": change.time, "state": change.state, **_change(change)}
            for change in simulation.jumps
        ],
        "impulses": [{"time": time, "state": state} for time, state in simulation.impulses],
    }


def _recording(recording: RecordingResult) -> dict[str, Any]:
    names = ("file", "sha256", "rows", "hold", "first", "last", "known_states", "elements")
    own = {name: getattr(recording, name) for name in names}
    return {**own, "bounded_between_nodes": recording.bounded}


def _fit(fit: Fit) -> dict[str, Any]:
    finite = fit.residual[np.isfinite(fit.residual)]
    return {
        "rms_Y": fit.size,
        "rms_residual": fit.residual if len(fit.residual) <= MAX_LISTED_CASES else None,
        "least_rms_residual": finite.min() if finite.size else None,
        "white": fit.white,
        "noise_ratio": fit.ratio,
    }


def _estimates(result: RunResult, estimation: EstimationResult) -> object:
    """Every estimate at the end with its truth: of the one case, or of several by number."""
    count = min(len(estimation.cases), MAX_LISTED_CASES)
    cases = [estimates_at_end(result, estimation, k) for k in range(count)]
    return cases[0] if len(cases) == 1 else {str(k): case for k, case in enumerate(cases)}


def _active_bounds(estimation: EstimationResult) -> list[dict[str, Any]] | None:
    """Which bounds hold the estimates at the end; None where there are no bounds."""
    return None if not estimation.active else [
        {"case": case, **asdict(bound)}
        for case, active in estimation.active.items() if case < MAX_LISTED_CASES
        for bound in active
    ]


def estimates_at_end(
    result: RunResult, estimation: EstimationResult, case: int
) -> dict[str, dict[str, Any]]:
    """By name: value, standard deviation, unit and truth at the end; what is unknown is None."""
    units = result.system.units
    kinds = (
        (estimation.names, estimation.parameters, estimation.parameters_std,
         estimation.true_parameters[-1]),
        (result.system.states, estimation.states, estimation.states_std,
         result.signals.states[-1]),
    )
    out: dict[str, dict[str, Any]] = {}
    for names, values, deviations, truth in kinds:
        for i, name in enumerate(names):
            out.setdefault(name, {
                "value": values[case, -1, i],
                "std": None if deviations is None else deviations[case, -1, i],
                "unit": unit_of(name, units) or None,
                "true": truth[i],
            })
    return out


def _excitation(excitation: Excitation) -> dict[str, Any]:
    # Before one window has passed the trailing window is a shorter one, which is no evidence.
    full = excitation.t - excitation.t[0] >= excitation.window * (1 - 1e-9)
    levels = excitation.pe_level[full & np.isfinite(excitation.pe_level)]
    return {
        "is_ie": excitation.is_ie,
        "t_c": excitation.t_c,
        "rho": excitation.rho,
        "normalised_min": excitation.level,
        "lambda_min": excitation.lambda_min,
        "condition": excitation.condition,
        "weakest_direction": excitation.weakest_direction.components,
        "determined_at": excitation.determined_at,
        "pe_level_min": levels.min() if levels.size else None,
        "window": excitation.window,
    }


def _cases(estimation: EstimationResult, metrics: Metrics) -> object:
    """List the cases with gains and metrics; ranges of the metrics when they are many."""
    columns = metrics.columns
    if len(estimation.cases) <= MAX_LISTED_CASES:
        return [
            {"case": case, "gains": gains, **{name: col[case] for name, col in columns.items()}}
            for case, gains in enumerate(estimation.cases)
        ]
    finite = {name: column[np.isfinite(column)] for name, column in columns.items()}
    return {"count": len(estimation.cases)} | {
        name: {"min": found.min() if found.size else None,
               "max": found.max() if found.size else None, "finite": found.size}
        for name, found in finite.items()
    }
