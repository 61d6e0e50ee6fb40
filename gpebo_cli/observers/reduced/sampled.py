"""The GPEBO observer at samples, as a controller runs it: from one sample to the next.

The state of the recursion is W = [ξ_a | ξ_b | Φ]; between samples, with the u and y of the hold,

    W' = A_0 W + [b_0 | D_0 | 0],      Y_{k+1} = ψ_{k+1} η.

The dynamic extension is carried over by the same collocation as in continuous
time; ψ and Y are then those of the new sample. What remains is the error of the hold: order 1 in
the time between samples for zoh, order 2 for linear. Nothing grows with the number of samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from gpebo_cli.errors import ModelError
from gpebo_cli.evidence.error_maps import error_steps
from gpebo_cli.findings import Assumption
from gpebo_cli.model.descriptor import Array, BoolArray, DescriptorSystem
from gpebo_cli.numerics.collocation import LinearSolution, solve
from gpebo_cli.numerics.mesh import Mesh
from gpebo_cli.numerics.problem import LinearEquation, LinearProblem
from gpebo_cli.numerics.radau import radau_rule
from gpebo_cli.observers._base import ByName, InitialError, SampledBlock, log_norm
from gpebo_cli.observers.reduced.matrices import ObserverMatrices, observer_matrices
from gpebo_cli.observers.reduced.regression import (
    VANISHING,
    regression_signals,
    resolve,
    term_sizes,
)
from gpebo_cli.observers.reduced.split import comparable, split_in_frame
from gpebo_cli.observers.reduced.system import Formulation, begin_at, choose_form, start_at
from gpebo_cli.recordings.hold import Hold, each_of, edges, held, of_outputs
from gpebo_cli.reduction.form import EquationForm, InputDerivatives
from gpebo_cli.regression.errors import ErrorSteps
from gpebo_cli.regression.samples import SampledRegression
from gpebo_cli.schema import instant
from gpebo_cli.settings import SolverSettings

_STAGES = 4  # per sample, order 7: beyond what any hold is good for
_PROBED = np.linspace(0.0, 1.0, 17)  # of the time ahead: what turns, does so by more than rounding
TOLERANCE = 1e-10  # where samples are far apart, steps are cut until this is reached


@dataclass(frozen=True, eq=False)
class SampledState:
    """The last sample, and everything that the recursion has to remember of the past."""

    t: float
    signals: Array  # (m + r,) [u; y]
    extension: Array  # (k, 1 + q + n_a) [ξ_a | ξ_b | Φ] in the coordinates of the basis
    row: Array  # (rows, p + 1) [ψ | Y]
    scale: Array  # (p,) largest terms of the columns of ψ before cancellation so far
    growth: float  # largest entry of Φ so far
    log_norm: float  # ln ‖Φ‖₂
    injectivity: float  # bound of Assumption 1's singular value so far
    error_estimate: float  # of the integration between samples, so far


@dataclass(frozen=True, eq=False)
class SampledObserver(Formulation):
    """A plant's observer in discrete time; immutable, see :class:`SampledState`."""

    hold: Hold
    errors: bool = False  # whether blocks say what errors of u and y do

    def responding(self, noisy: BoolArray) -> SampledObserver:
        """The same with ``errors``, unless noise of [u; y] (m + r,) is in matrices or slopes."""
        return replace(self, errors=not self.form.noise_enters(noisy))

    def assumptions(self, reached: SampledState) -> tuple[Assumption, ...]:
        """What the observer needed so far, with its evidence."""
        evidence = {"smallest_singular_value_at_least": reached.injectivity}
        return self.needed(self.first.split.rank, evidence)

    def truth(self, extension: Array) -> InitialError:
        """What the parameters are, from [ξ_a | ξ_b | Φ] (K, k, 1 + p) at the times to be asked."""
        return InitialError(
            self.begin.dual, self.xi_a0, self.first.split.dual, lambda _t: extension, self.units
        )

    def advance(
        self, state: SampledState | None, t: Array, u: Array, y: Array
    ) -> tuple[SampledState, SampledBlock]:
        """Carry the recursion over the samples u (K, m), y (K, r) at t (K,), after ``state.t``.

        The state is None before the first sample.
        """
        own = np.hstack([u, y])
        times, signals, start, error = t, own, self.start, 0.0
        z, steps = [], []
        if state is None:  # the extension starts at the first sample
            z.append(start[None])
            steps.append(np.eye(len(start), len(start) + 2 * own.shape[1])[None])
        else:
            times = np.concatenate([[state.t], t])
            signals = np.concatenate([state.signals[None], own])
            start, error = state.extension, state.error_estimate
        if len(times) > 1:
            solution = self._carried(times, signals, start)
            mesh, error = solution.trajectory.mesh, max(error, solution.error_estimate)
            ends = np.searchsorted(mesh.edges, times[1:]) - 1  # every sample is an edge
            z.append(solution.trajectory.values[ends, -1])
            if self.errors:
                lines = np.array([word == "linear" for word in each_of(self.hold, own.shape[1])])
                steps.append(error_steps(mesh, times, lines, *solution.extras))
        step = np.concatenate(steps) if self.errors else None
        return self._block(np.concatenate(z), t, own, state, step, error)

    def _carried(self, times: Array, signals: Array, start: Array) -> LinearSolution:
        """[ξ_a | ξ_b | Φ] from ``start`` (k, ·) at the first to the last of the times (N,)."""
        signal = held(times, signals, self.hold)

        def coefficients(at: Array, inside: Array) -> LinearEquation:
            o, driving = self._matrices(at, inside, signal(at, inside))
            f = o.forcing(driving, start.shape[1])
            noise = (o.dynamics, o.of_noise(o.from_signals, self.system.m)) if self.errors else ()
            return LinearEquation(None, o.dynamics, f, noise)

        source = self.system.coefficients
        cuts = source.breakpoints(float(times[0]), float(times[-1]))
        cells, _ = source.of_time.resolved(edges(times, cuts))
        problem = LinearProblem(coefficients, start, name=f"observer of plant {self.system.name}")
        return solve(
            problem, Mesh(cells, radau_rule(_STAGES)),
            tol=max(self.solver.tol, TOLERANCE), max_elements=self.solver.max_elements,
        )

    def _matrices(
        self, t: Array, inside: Array, signals: Array
    ) -> tuple[ObserverMatrices, Array]:
        """The matrices at the times t (N,), and [v; y] (N, · + r, 1) from [u; y] (N, m + r)."""
        rank_tol = self.solver.rank_tol
        o = observer_matrices(self.form, t, inside, rank_tol, self.first, signals=signals)
        rank = self.first.split.rank
        if o.split.rank != rank:
            raise ModelError(
                f"plant {self.system.name}: the rank of E changes from {rank} to {o.split.rank} "
                f"before t = {instant(t[-1], 6)}; the observer needs it constant"
            )
        return o, self.form.driving(t, inside, signals)

    def _block(
        self, z: Array, t: Array, signals: Array, before: SampledState | None, step: Array | None,
        error: float,
    ) -> tuple[SampledState, SampledBlock]:
        """Regression and state map from [ξ_a | ξ_b | Φ], z (K, k, ·), and what errors become."""
        system, basis = self.system, self.basis
        o, driving = self._matrices(t, t, signals)
        equations = o.equations(driving, alone=True)
        assembled = regression_signals(z, basis, equations)
        Phi = comparable(np.concatenate([self.start[None], z])[..., 1 + system.q :], self.units)
        growth = float(np.abs(Phi[1:]).max(initial=0.0))
        smallest = float(o.injectivity.min())
        of_gain, scale = term_sizes(z, basis, equations)
        if basis.shape[1] > o.split.rank:
            # What the kernel of E, which turns, leaves of z holds but for errors of z's own size.
            own = (np.abs(z[:, :, 1:]) / self.units[:, None]).max(axis=1, initial=0.0)[:, None]
            carried = np.abs(equations.on_basis) @ (self.units[:, None] * own)
            scale = np.maximum(scale, carried.max(axis=1, initial=0.0))
        if before is not None:
            growth, scale[0] = max(growth, before.growth), np.maximum(scale[0], before.scale)
            smallest = min(smallest, before.injectivity)
        scale = np.maximum.accumulate(scale, axis=0)
        noise = (np.abs(assembled.psi) <= VANISHING * scale[:, None]).all(axis=2, keepdims=True)
        psi = np.where(noise, 0.0, assembled.psi)
        kept = slice(-system.r, None) if self.regression == "paper" else slice(None)
        rows = np.concatenate([psi, assembled.Y[:, :, None]], axis=2)[:, kept]
        previous, last = (rows[0], t[0]) if before is None else (before.row, before.t)
        state = SampledState(
            float(t[-1]), signals[-1], z[-1], rows[-1], scale[-1], growth, log_norm(Phi[-1]),
            smallest, error,
        )
        regression = SampledRegression(
            t, np.diff(t, prepend=last), np.concatenate([previous[None], rows]),
            of_outputs(self.hold, system.m), scale=scale,
        )
        errors = None if step is None else ErrorSteps.at(
            step, o.errors(kept, system.m, alone=True)
        )
        resolve(assembled, slice(None), of_gain(), self.form)
        return state, SampledBlock(
            regression, assembled.offset, assembled.gain, z, errors, self.form.units.states
        )


def sampled_observer(
    system: DescriptorSystem, solver: SolverSettings, hold: Hold, start: float, sample: Array,
    derivatives: InputDerivatives | None, *,
    xi_a0: Mapping[str, float] | list[float] | None, weights: ByName | None, regression: str,
    form: str, ahead: float,
) -> SampledObserver:
    """The observer in discrete time, whose first sample [u; y] (m + r,) is at ``start`` seconds.

    Settings are those of the observer; auto is as given where Assumption 1 holds at the start. What
    the plant does is judged by the seconds ``ahead``.
    """
    t = np.array([start])
    used, first, note = choose_form(
        system, t, t, sample[None], derivatives, solver, form, weights, ahead=ahead
    )
    if not _kernel_is_fixed(used, first, t + ahead * _PROBED, sample, solver.rank_tol):
        eye = np.eye(system.n)
        split = replace(first.split, basis=eye, dual=eye, frame=None)
        first = replace(first, split=split, on_basis=first.algebraic)
    begin = start_at(used, first, used.driving(t, t, sample[None]))
    xi = begin_at(xi_a0, used, first, begin)
    return SampledObserver(used, solver, first, begin, xi, regression, note, hold)


def _kernel_is_fixed(
    form: EquationForm, first: ObserverMatrices, t: Array, sample: Array, rank_tol: float
) -> bool:
    """Whether kernel and range of E stay at times (N,): the extension needs n_a coordinates, not n.

    A kernel that starts to turn later on is refused then.
    """
    frame = first.split.frame
    if frame is None:
        return False
    signals = np.repeat(sample[None], len(t), axis=0)
    E = form.mass(t, t, signals) / form.units.equations[:, None]
    return split_in_frame(E, frame, form.units.states, rank_tol) is not None
